static const whole ${own}_senders[$count] = {$senders};
static const whole ${own}_receivers[$count] = {$receivers};

static void begin_$own(model *m) {
  for (int w = 0; w < $count; w++) {
    ${own}_way *way = &m->ways_$own[w];
    const double *first = packet_$own(m, -1, (int)${own}_senders[w]);
    for (int k = 0; k < $channels; k++) way->held[k] = first[k];
    for (int k = 0; k < $kept; k++) way->coming[k].state = 0;
    way->effective = way->gap = way->arrived = -1;
    way->bad = 0;
  }
}

/* A packet goes out on all ways of its sender. */
static void draw_$own(model *m, int sender, long long number) {
  static const uint64_t key[2] = {$key};
  static const double seconds[$count] = {$seconds}, trace[] = {$trace};
  static const long long nominal[$count] = {$delays};
  for (int w = 0; w < $count; w++) {
    ${own}_way *way = &m->ways_$own[w];
    ${own}_coming *one = &way->coming[number % $kept];
    if (${own}_senders[w] != sender) continue;
    double u[4], late = seconds[w];
    if (number == 0) {
      chances(1, key[0], key + 1, 1, ${own}_senders + w, ${own}_receivers + w, &u);
      way->bad = u[0] < $bad;
    }
    chances(1, key[0], key + 1, number + 2, ${own}_senders + w, ${own}_receivers + w, &u);
    int lost = u[1] < (way->bad ? $one_minus_h : $one_minus_k);
    way->bad = way->bad ? u[0] < 1 - $r : u[0] < $p;
    if ($jitter > 0) late += $jitter * deviate($distribution, u[2], u[3]);
    if (late < 0) late = 0;
    if ($traced) {
      late = trace[number % $rows];
      lost = 0;
    }
    late /= $quantum;
    lost |= !(late < LONGEST);
    const long long fine = lost ? nominal[w] * ONE : (long long)rint(late * ONE);
    one->due = ($phase + number * $period) * ONE + fine;
    one->number = number;
    one->state = 1 + lost;
  }
}

/* The packet in effect on a way at an instant: what has come is, and what should have come is missed. */
static const double *heard_$own(model *m, int w, long long at, int *missing) {
  ${own}_way *way = &m->ways_$own[w];
  for (int k = 0; k < $kept; k++) {
    ${own}_coming *one = &way->coming[k];
    if (!one->state || one->due > at * ONE) continue;
    if (one->state == 2) {
      if (one->number > way->gap) way->gap = one->number;
    } else if (($newest || one->due == way->arrived) ? one->number > way->effective : one->due > way->arrived) {
      way->effective = one->number;
      way->arrived = one->due;
      for (int c = 0; c < $channels; c++)
        way->held[c] = m->$own[one->number % $ring][${own}_senders[w]][c];
    }
    one->state = 0;
  }
  *missing = way->gap > way->effective;
  return way->held;
}

