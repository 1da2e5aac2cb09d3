/* The number of the newest packet that was sent until an instant: below 0 there is none. */
static long long newest_${link.name}(long long at) {
  return at < ${link.phase} ? -1 : (at - ${link.phase}) / ${link.period};
}

/* That packet, or what is heard of everybody before the first arrives. */
static const double *packet_${link.name}(const model *m, long long at, int sender) {
  static const double start[${link.start | length}][${link.channels | length}] = {{% for values in link.start %}{${values | row}}${", " if not loop.last else ""}{% endfor %}};
  const long long number = newest_${link.name}(at);
  return number < 0 ? start[sender] : m->${link.name}[number % ${link.ring}][sender];
}

