/* The packet in effect on a way at an instant. */
static const double *heard_${link.name}(model *m, int w, long long at, int *missing) {
  static const int senders[${link.ways | length or 1}] = {${link.ways | map("first") | row}};
  static const long long delays[${link.ways | length or 1}] = {${quanta(link) | row}};
  *missing = 0;
  return packet_${link.name}(m, at - delays[w], senders[w]);
}

