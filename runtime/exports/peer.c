% include "title.c"
#include "${include}"
#include <math.h>

/* Products and sums round one by one, as they are written. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

% for local, label, value in constants
#define ${local} ${value | number} /* ${label | comment} [${units[label] | comment}] */
% endfor

/* Which kind of instant the next one is, and how long it is until the one after, in quanta. */
static int ${name}_kind(const ${name} *peer) {
  static const short kinds[${peer.instants | length}] = {${peer_type_of | row}};
  return kinds[peer->instant];
}

static double ${name}_now(const ${name} *peer) {
  return (double)peer->quanta * ${quantum.numerator | float} / ${quantum.denominator | float};
}

% for line in peer.sending
% set send = peer.peer_type.sends[line.sending]
% set lines, values = computed(send.send)
static void ${name}_own_${line.name}(const ${name} *peer, const ${name}_in *in, ${name}_${line.name} *packet) {
  const double t = ${name}_now(peer);
  (void)in;
  (void)t;
% for text in lines
  ${text}
% endfor
% for entry in line.packet if entry.name in send.channels
  packet->${entry.member} = ${values[send.channels.index(entry.name)]};
% endfor
% if line.missing
  packet->missing = 0;
% endif
}

% endfor
% for p in ticking
% set partition = peer.peer_type.clocks[p]
% set own_of, receives = received(p)
/* A tick of ${partition.clock | comment}. */
static void ${name}_tick_${p}(${name} *peer, const ${name}_in *in, double t) {
  (void)in;
  (void)t;
% for line in own_of
  ${name}_${line.name} own_${line.name};
  ${name}_own_${line.name}(peer, in, &own_${line.name});
% endfor
% for item in receives
% set r = "r" ~ loop.index0
% if not item.line
  const double ${r} = 0.0;
  (void)${r};
% else
% if item.extreme
  double ${r} = NAN;
% else
  static const double weights_${loop.index0}[${item.weights | length}] = {${item.weights | row}};
  double ${r} = 0.0;
% endif
  for (int k = 0; k < ${item.weights | length}; k++) {
% for text in item.lines
    ${text}
% endfor
% if item.extreme
    ${r} = f${item.extreme}(${r}, ${item.value});
% else
    ${r} += weights_${loop.index0}[k] * ${item.value};
% endif
  }
% if item.divided
  ${r} /= ${item.weights | length | float};
% endif
% endif
% endfor
% set lines, values = computed(partition.tick, p)
% for text in lines
  ${text}
% endfor
% for value in values
  peer->${member(p, loop.index0)} = ${value};
% endfor
% for hold in peer.peer_type.holds if hold.clock == partition.clock
% set late = "peer->late[" ~ peer.peer_type.holds.index(hold) ~ "]"
  for (int k = ${stored - 1}; k > 0; k--) ${late}[k] = ${late}[k - 1];
  ${late}[0] = peer->${member(p, hold.output)};
% endfor
}

% endfor
% for move in peer.moves
% set lines, stores = moved(move)
/* What this computer moves, over ${(move.quanta * quantum) | float} s. */
static void ${name}_move_${loop.index0}(${name} *peer) {
  const double t = ${name}_now(peer);
  (void)t;
% for text in lines
  ${text}
% endfor
% for place, value in stores.items()
  peer->x[${place}] = ${value};
% endfor
}

% endfor
void ${name}_start(${name} *peer) {
  static const ${name} begin = {0, 0, {${starts | row}}, {${outputs | row}}, {${zeros | row}}, {${late | row}}, {${settings | row}}};
  *peer = begin;
}

void ${name}_clear(${name}_in *in) {
  (void)in;
% for line in peer.lines
% for sender in line.senders
% set k = loop.index0
% for entry in line.packet
  in->${line.name}[${k}].${entry.member} = ${sender.start[loop.index0] | number};
% endfor
% endfor
% endfor
% for line in peer.lines if line.missing
  for (int k = 0; k < ${line.senders | length}; k++) in->${line.name}[k].missing = 0;
% endfor
}

double ${name}_time(const ${name} *peer) { return ${name}_now(peer); }

long long ${name}_next(const ${name} *peer) {
  static const long long lengths[] = {${lengths | row}};
  return peer->quanta + lengths[${name}_kind(peer)];
}

void ${name}_send(const ${name} *peer, const ${name}_in *in, ${name}_out *out) {
  (void)in;
  (void)out;
% for line in peer.sending
  out->sent_${line.name} = 0;
% endfor
  switch (${name}_kind(peer)) {
% for item in peer_types
  case ${loop.index0}:
% for partition in item.sends
    ${name}_own_${over[partition]}(peer, in, &out->${over[partition]});
    out->sent_${over[partition]} = 1;
% endfor
    break;
% endfor
  }
}

void ${name}_force(${name} *peer, const ${name}_in *in, ${name}_out *out) {
  const double t = ${name}_now(peer);
  (void)in;
  (void)out;
  (void)t;
  switch (${name}_kind(peer)) {
% for item in peer_types
  case ${loop.index0}:
% for p in item.ticks
    ${name}_tick_${p}(peer, in, t);
% endfor
% for act in item.acts
    peer->u[${act.hold}] = peer->late[${act.hold}][${act.lag}];
% endfor
    break;
% endfor
  }
% for local, value in forces
  out->${local} = ${value};
% endfor
}

void ${name}_move(${name} *peer) {
  const long long next = ${name}_next(peer);
  switch (${name}_kind(peer)) {
% for item in peer_types
  case ${loop.index0}:
    ${name}_move_${item.move}(peer);
    break;
% endfor
  }
  peer->quanta = next;
  peer->instant = (peer->instant + 1) % ${peer.instants | length};
}

void ${name}_tick(${name} *peer, const ${name}_in *in, ${name}_out *out) {
  ${name}_send(peer, in, out);
  ${name}_force(peer, in, out);
  ${name}_move(peer);
}
