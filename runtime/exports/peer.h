$title
#ifndef $guard
#define $guard

$packets
/* What a peer measures and hears. All numbers are in SI units. */
typedef struct {
$heard
} ${name}_in;

/* What it puts out: forces on what moves outside, and what it sends. */
typedef struct {
$sent
} ${name}_out;

/* All that it remembers. */
typedef struct {
  long long quanta; /* when its next instant is, in units of $quantum s */
  int instant;      /* which of the $instants of a frame */
$memory
} $name;

/* Begin at time 0, when nothing is computed yet. */
void ${name}_start($name *peer);

/* Hear of everybody what stands for packets that have not arrived yet: where they start. */
void ${name}_unheard(${name}_in *in);

/* The time of its next instant, in s. */
double ${name}_time(const $name *peer);

/* The time of the instant after that, in quanta. */
long long ${name}_next(const $name *peer);

/* What is sent at this instant: where a member "..._sent" is 1, a packet goes out. */
void ${name}_send(const $name *peer, const ${name}_in *in, ${name}_out *out);

/* Compute what is due at this instant, of what is measured and heard now. */
void ${name}_force($name *peer, const ${name}_in *in, ${name}_out *out);

/* Go to the next instant: what this computer moves moves. */
void ${name}_move($name *peer);

/* All of one instant: send, force, move. Call it at ${name}_time. */
void ${name}_tick($name *peer, const ${name}_in *in, ${name}_out *out);

#endif
