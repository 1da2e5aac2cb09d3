/* The packet in effect on an arc at an instant. */
static const double *received_${link.name}(model *m, int w, long long at, int *missing) {
  static const int senders[${link.arcs | length or 1}] = {${link.arcs | map("first") | row}};
  static const long long delays[${link.arcs | length or 1}] = {${quanta(link) | row}};
  *missing = 0;
  return packet_${link.name}(m, at - delays[w], senders[w]);
}

