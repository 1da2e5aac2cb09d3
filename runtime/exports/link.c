/* The number of the newest packet that was sent until an instant: below 0 there is none. */
static long long newest_$own(long long at) {
  return at < $phase ? -1 : (at - $phase) / $period;
}

/* That packet, or what is heard of everybody before the first arrives. */
static const double *packet_$own(const model *m, long long at, int sender) {
  static const double start[$peers][$channels] = {$start};
  const long long number = newest_$own(at);
  return number < 0 ? start[sender] : m->$own[number % $ring][sender];
}

