% set law = link.luck.law
% set trace = [] if law.trace is none else law.trace.tolist()
static const whole ${link.name}_senders[${link.ways | length or 1}] = {${link.ways | map("first") | row}};
static const whole ${link.name}_receivers[${link.ways | length or 1}] = {${link.ways | map("last") | row}};

static void begin_${link.name}(model *m) {
  for (int w = 0; w < ${link.ways | length or 1}; w++) {
    ${link.name}_way *way = &m->ways_${link.name}[w];
    const double *first = packet_${link.name}(m, -1, (int)${link.name}_senders[w]);
    for (int k = 0; k < ${link.channels | length}; k++) way->held[k] = first[k];
    for (int k = 0; k < ${link.kept}; k++) way->coming[k].state = 0;
    way->effective = way->gap = way->arrived = -1;
    way->bad = 0;
  }
}

/* A packet goes out on all ways of its sender. */
static void draw_${link.name}(model *m, int sender, long long number) {
  static const uint64_t key[2] = {${link.key[0]}u, ${link.key[1]}u};
  static const double seconds[${link.ways | length or 1}] = {${link.delays | map("float") | row}}, trace[] = {${trace | row}};
  static const long long nominal[${link.ways | length or 1}] = {${quanta(link) | row}};
  for (int w = 0; w < ${link.ways | length or 1}; w++) {
    ${link.name}_way *way = &m->ways_${link.name}[w];
    ${link.name}_coming *one = &way->coming[number % ${link.kept}];
    if (${link.name}_senders[w] != sender) continue;
    double u[4], late = seconds[w];
    if (number == 0) {
      chances(1, key[0], key + 1, 1, ${link.name}_senders + w, ${link.name}_receivers + w, &u);
      way->bad = u[0] < ${law.bad | number};
    }
    chances(1, key[0], key + 1, number + 2, ${link.name}_senders + w, ${link.name}_receivers + w, &u);
    int lost = u[1] < (way->bad ? ${law.one_minus_h | number} : ${law.one_minus_k | number});
    way->bad = way->bad ? u[0] < 1 - ${law.r | number} : u[0] < ${law.p | number};
    if (${law.jitter | number} > 0) late += ${law.jitter | number} * deviate(${law.distribution | upper}, u[2], u[3]);
    if (late < 0) late = 0;
    if (${1 if trace else 0}) {
      late = trace[number % ${trace | length or 1}];
      lost = 0;
    }
    late /= ${scene.quantum | float | number};
    lost |= !(late < LONGEST);
    const long long fine = lost ? nominal[w] * ONE : (long long)rint(late * ONE);
    one->due = (${link.phase} + number * ${link.period}) * ONE + fine;
    one->number = number;
    one->state = 1 + lost;
  }
}

/* The packet in effect on a way at an instant: what has come is, and what should have come is missed. */
static const double *heard_${link.name}(model *m, int w, long long at, int *missing) {
  ${link.name}_way *way = &m->ways_${link.name}[w];
  for (int k = 0; k < ${link.kept}; k++) {
    ${link.name}_coming *one = &way->coming[k];
    if (!one->state || one->due > at * ONE) continue;
    if (one->state == 2) {
      if (one->number > way->gap) way->gap = one->number;
    } else if ((${link.luck.newest | int} || one->due == way->arrived) ? one->number > way->effective : one->due > way->arrived) {
      way->effective = one->number;
      way->arrived = one->due;
      for (int c = 0; c < ${link.channels | length}; c++)
        way->held[c] = m->${link.name}[one->number % ${link.ring}][${link.name}_senders[w]][c];
    }
    one->state = 0;
  }
  *missing = way->gap > way->effective;
  return way->held;
}

