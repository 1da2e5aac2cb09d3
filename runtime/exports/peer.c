$title
#include "$include"
#include <math.h>

/* Products and sums round one by one, as they are written. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

$parameters
/* Which kind of instant the next one is, and how long it is until the one after, in quanta. */
static int ${name}_kind(const $name *peer) {
  static const short kinds[$instants] = {$kinds};
  return kinds[peer->instant];
}

static double ${name}_now(const $name *peer) {
  return (double)peer->quanta * $numerator / $denominator;
}

$functions
void ${name}_start($name *peer) {
  static const $name begin = {0, 0, {$states}, {$outputs}, {$holds}, {$late}, {$settings}};
  *peer = begin;
}

void ${name}_unheard(${name}_in *in) {
  (void)in;
$unheard}

double ${name}_time(const $name *peer) { return ${name}_now(peer); }

long long ${name}_next(const $name *peer) {
  static const long long lengths[] = {$lengths};
  return peer->quanta + lengths[${name}_kind(peer)];
}

void ${name}_send(const $name *peer, const ${name}_in *in, ${name}_out *out) {
  (void)in;
  (void)out;
$unsent  switch (${name}_kind(peer)) {
$sends  }
}

void ${name}_force($name *peer, const ${name}_in *in, ${name}_out *out) {
  const double t = ${name}_now(peer);
  (void)in;
  (void)out;
  (void)t;
  switch (${name}_kind(peer)) {
$ticks  }
$forces}

void ${name}_move($name *peer) {
  const long long next = ${name}_next(peer);
  switch (${name}_kind(peer)) {
$moves  }
  peer->quanta = next;
  peer->instant = (peer->instant + 1) % $instants;
}

void ${name}_tick($name *peer, const ${name}_in *in, ${name}_out *out) {
  ${name}_send(peer, in, out);
  ${name}_force(peer, in, out);
  ${name}_move(peer);
}
