/* The packet in effect on a way at an instant. */
static const double *heard_$own(model *m, int w, long long at, int *missing) {
  static const int senders[$count] = {$senders};
  static const long long delays[$count] = {$delays};
  *missing = 0;
  return packet_$own(m, at - delays[w], senders[w]);
}

