% set trace = [] if link.laws[0].trace is none else link.laws[0].trace.tolist()
static const struct {
  double bad, bad_loses, good_loses, p, r, jitter;
  int distribution, zero; /* zero: a lost packet is reported as missing */
} ${link.name}_laws[] = {
% for law in link.laws
  {${law.bad | number}, ${law.one_minus_h | number}, ${law.one_minus_k | number}, ${law.p | number}, ${law.r | number}, ${law.jitter | number}, ${law.distribution | upper}, ${law.zero | int}},
% endfor
};
static const int ${link.name}_law_of[${link.arcs | length or 1}] = {${link.law_of | row}};
static const whole ${link.name}_senders[${link.arcs | length or 1}] = {${link.arcs | map("first") | row}};
static const whole ${link.name}_receivers[${link.arcs | length or 1}] = {${link.arcs | map("last") | row}};

static void begin_${link.name}(model *m) {
  for (int w = 0; w < ${link.arcs | length or 1}; w++) {
    ${link.name}_arc *arc = &m->arcs_${link.name}[w];
    const double *first = packet_${link.name}(m, -1, (int)${link.name}_senders[w]);
    for (int k = 0; k < ${link.channels | length}; k++) arc->held[k] = first[k];
    for (int k = 0; k < ${link.stored}; k++) arc->coming[k].state = 0;
    arc->effective = arc->gap = arc->arrived = -1;
    arc->bad = 0;
  }
}

/* A packet goes out on all ways of its sender. */
static void draw_${link.name}(model *m, int sender, long long number) {
  static const uint64_t key[2] = {${link.key[0]}u, ${link.key[1]}u};
  static const double seconds[${link.arcs | length or 1}] = {${link.delays | map("float") | row}}, trace[] = {${trace | row}};
  static const long long nominal[${link.arcs | length or 1}] = {${quanta(link) | row}};
  for (int w = 0; w < ${link.arcs | length or 1}; w++) {
    ${link.name}_arc *arc = &m->arcs_${link.name}[w];
    ${link.name}_coming *one = &arc->coming[number % ${link.stored}];
    if (${link.name}_senders[w] != sender) continue;
    const int law = ${link.name}_law_of[w];
    double u[4], late = seconds[w];
    if (number == 0) {
      chances(1, key[0], key + 1, 1, ${link.name}_senders + w, ${link.name}_receivers + w, &u);
      arc->bad = u[0] < ${link.name}_laws[law].bad;
    }
    chances(1, key[0], key + 1, number + 2, ${link.name}_senders + w, ${link.name}_receivers + w, &u);
    int lost = u[1] < (arc->bad ? ${link.name}_laws[law].bad_loses : ${link.name}_laws[law].good_loses);
    arc->bad = arc->bad ? u[0] < 1 - ${link.name}_laws[law].r : u[0] < ${link.name}_laws[law].p;
    if (${link.name}_laws[law].jitter > 0)
      late += ${link.name}_laws[law].jitter * deviate(${link.name}_laws[law].distribution, u[2], u[3]);
    if (late < 0) late = 0;
    if (${1 if trace else 0}) {
      late = trace[number % ${trace | length or 1}];
      lost = 0;
    }
    late /= ${topology.quantum | float | number};
    lost |= !(late < LONGEST);
    const long long fine = lost ? nominal[w] * ONE : (long long)rint(late * ONE);
    one->due = (${link.phase} + number * ${link.period}) * ONE + fine;
    one->number = number;
    one->state = 1 + lost;
  }
}

/* The packet in effect on an arc at an instant: what has come is, and what should have come is missed. */
static const double *received_${link.name}(model *m, int w, long long at, int *missing) {
  ${link.name}_arc *arc = &m->arcs_${link.name}[w];
  for (int k = 0; k < ${link.stored}; k++) {
    ${link.name}_coming *one = &arc->coming[k];
    if (!one->state || one->due > at * ONE) continue;
    if (one->state == 2) {
      if (one->number > arc->gap) arc->gap = one->number;
    } else if ((${link.arrival_process.newest | int} || one->due == arc->arrived) ? one->number > arc->effective : one->due > arc->arrived) {
      arc->effective = one->number;
      arc->arrived = one->due;
      for (int c = 0; c < ${link.channels | length}; c++)
        arc->held[c] = m->${link.name}[one->number % ${link.ring}][${link.name}_senders[w]][c];
    }
    one->state = 0;
  }
  *missing = arc->gap > arc->effective && ${link.name}_laws[${link.name}_law_of[w]].zero;
  return arc->held;
}

