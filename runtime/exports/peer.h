% include "title.c"
#ifndef APC_${name}_H
#define APC_${name}_H

#ifdef __cplusplus
extern "C" {
#endif

% for line in peer.lines
/* A packet of ${line.link | comment}. */
typedef struct {
% filter members
% for entry in line.packet
double ${entry.member} | ${entry.name} [${entry.unit}]
% endfor
% if line.missing
int missing | 1: it is late, and what this peer would send stands in for it
% endif
% endfilter
} ${name}_${line.name};

% endfor
/* What a peer measures and hears. All numbers are in SI units. */
typedef struct {
% filter members
% for place, local in peer.measured.items()
double ${local} | ${states[place].name} [${states[place].unit}]
% endfor
% for line in peer.lines if line.senders
${name}_${line.name} ${line.name}[${line.senders | length}] | the newest packets of ${line.senders[:8] | join(", ", "name")}${", ..." if line.senders | length > 8 else ""}
% endfor
% endfilter
} ${name}_in;

/* What it puts out: forces on what moves outside, and what it sends. */
typedef struct {
% filter members
% for local, force in peer.forces.items()
double ${local} | the force on ${force.name.rpartition(".")[0]} [N]
% endfor
% for line in peer.sending
${name}_${line.name} ${line.name} | what it sends
int sent_${line.name} | whether it does now
% endfor
% endfilter
} ${name}_out;

/* All that it remembers. */
typedef struct {
  long long quanta; /* when its next instant is, in units of ${peer.schedule.quantum | float} s */
  int instant;      /* which of the ${peer.instants | length} of a frame */
% filter members
double x[${states | length or 1}] | ${inside | join(", ")}
double y[${computed | length or 1}] | ${computed | join(", ")}
double u[${holds | length or 1}] | what acts of ${holds | join(", ", "name")}
double late[${holds | length or 1}][${stored}] | what was computed of these, the newest first
double p[${peer.settable | length or 1}] | parameters that ticks read: ${settings | join(", ")}
% endfilter
} ${name};

/* Begin at time 0, when nothing is computed yet. */
void ${name}_start(${name} *peer);

/* Hear of everybody what stands for packets that have not arrived yet: where they start. */
void ${name}_clear(${name}_in *in);

/* The time of its next instant, in s. */
double ${name}_time(const ${name} *peer);

/* The time of the instant after that, in quanta. */
long long ${name}_next(const ${name} *peer);

/* What is sent at this instant: where a member "sent_..." is 1, a packet goes out. */
void ${name}_send(const ${name} *peer, const ${name}_in *in, ${name}_out *out);

/* Compute what is due at this instant, of what is measured and heard now. */
void ${name}_force(${name} *peer, const ${name}_in *in, ${name}_out *out);

/* Go to the next instant: what this computer moves moves. */
void ${name}_move(${name} *peer);

/* All of one instant: send, force, move. Call it at ${name}_time. */
void ${name}_tick(${name} *peer, const ${name}_in *in, ${name}_out *out);

#ifdef __cplusplus
}
#endif

#endif
