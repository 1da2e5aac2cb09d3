/* Plays frames of all peers: what `hearing` lists, between the kernels of the members' segments.

The kernels stand before this text (see `machine`), which also says what every field is. All fields have 8
bytes; addresses are those of NumPy's arrays, which outlive a call. A row of a packet, a carry or what is
heard is contiguous: a number a peer.
*/

enum { TOTAL, COMPLETE, WEIGHED, DELIVER, ON_WAYS, COPY, COPY_WAYS, LOOK, MOVE, WORK };
enum { UNIFORM, NORMAL, PARETO };

typedef struct {
  whole ways, slots, ticks, phase, period, first_tick, tick_period, kept, buckets, newest, zero, channels;
  whole distribution, traced;
  double p, r, one_minus_h, one_minus_k, bad_share, jitter, quantum;
  const double *trace, *delays;                   /* (traced,); of each way, in seconds */
  const whole *nominal, *senders, *receivers;     /* of each way: quanta, peers of the scene */
  const whole *columns, *keys;                    /* of each way's sender; (channels, slots) */
  double *held;                                   /* (channels, ways): what is in effect */
  whole *effective, *gap, *arrived;               /* (ways,): numbers, and when the first arrived */
  int8_t *bad;                                    /* (ways,) */
  int32_t *heads, *next;                          /* (buckets,), (2, kept, ways): packets by their tick */
  whole *when;                                    /* (kept, ways), where the order of arrival matters */
  uint64_t key[2];
  whole heard;                                    /* ticks so far */
} Route;

typedef struct {
  whole count, column, recorded, sites, own, impulse_rows;
  double *carry, *heard;
  const double *constants;
  const double *impulses;                         /* (frames, rows, sites) of this call */
  const whole *site;
} Member;

typedef struct {
  whole kind, a, b, c, d, e, f, g;
  double x, y, z;
  const whole *p, *q;
  const double *u;
  double *v, *w;
} Operation;

typedef struct {
  whole frames_kept, keys, peers, operations, routes, marks, width, parts, frame;
  double *packets, *totals;
  Operation *operation;
  Route *route;
  Member *member;
} Plan;

#define ONE 1048576 /* an arrival's finest part of a quantum: 2^-20, as in `timetable` */
#define LONGEST 1099511627776.0
#define START (-1)

static inline uint64_t high(uint64_t a, uint64_t b, uint64_t *low) {
#ifdef __SIZEOF_INT128__
  unsigned __int128 both = (unsigned __int128)a * b;
  *low = (uint64_t)both;
  return (uint64_t)(both >> 64);
#else
  uint64_t ah = a >> 32, al = a & 0xffffffffu, bh = b >> 32, bl = b & 0xffffffffu;
  uint64_t middle = ah * bl + (al * bl >> 32), other = al * bh + (middle & 0xffffffffu);
  *low = a * b;
  return ah * bh + (middle >> 32) + (other >> 32);
#endif
}

/* Philox-4x64-10, as in `network.philox`: numbers from 0 to less than 1. */
static inline void chances(const uint64_t *key, whole block, whole sender, whole receiver, double *u) {
  uint64_t one = block, two = sender, three = receiver, four = 0, low, other_low;
  uint64_t first = key[0], second = key[1];
  for (int turn = 0; turn < 10; turn++) {
    uint64_t upper = high(0xD2E7470EE14C6C93u, one, &low), other = high(0xCA5A826395121157u, three, &other_low);
    one = other ^ two ^ first;
    two = other_low;
    three = upper ^ four ^ second;
    four = low;
    first += 0x9E3779B97F4A7C15u;
    second += 0xBB67AE8584CAA73Bu;
  }
  u[0] = (one >> 11) * 0x1p-53;
  u[1] = (two >> 11) * 0x1p-53;
  u[2] = (three >> 11) * 0x1p-53;
  u[3] = (four >> 11) * 0x1p-53;
}

static inline double deviate(whole distribution, double one, double two) {
  if (distribution == UNIFORM) return 2 * one - 1;
  if (distribution == NORMAL) return sqrt(-2 * log1p(-one)) * cos(6.283185307179586 * two);
  double late = (pow(1 - one, -1.0 / 3) - 1.5) * 4 / 3;
  return late < 4 ? late : 4;
}

static inline whole quotient_up(whole a, whole b) { /* b > 0 */
  return a / b + (a % b > 0);
}

/* Send packet `number` of every way: draw its luck and put it where the tick that first sees it will look. */
static int draw(Route *r, whole number) {
  whole slot = number % r->kept, sent = r->phase + r->period * number;
  int chance = !r->traced && (r->jitter > 0 || r->bad_share > 0 || r->one_minus_k > 0 || r->p > 0);
  for (whole w = 0; w < r->ways; w++) {
    double late;
    int lost;
    if (r->traced) {
      late = r->trace[number % r->traced];
      lost = 0;
    } else {
      double u[4] = {1, 1, 0, 0};
      if (number == 0) {
        double first[4];
        chances(r->key, 1, r->senders[w], r->receivers[w], first);
        r->bad[w] = first[0] < r->bad_share;
      }
      if (chance) chances(r->key, number + 2, r->senders[w], r->receivers[w], u);
      int bad = r->bad[w];
      lost = u[1] < (bad ? r->one_minus_h : r->one_minus_k);
      r->bad[w] = bad ? u[0] < 1 - r->r : u[0] < r->p;
      late = r->delays[w];
      if (r->jitter > 0) {
        late += r->jitter * deviate(r->distribution, u[2], u[3]);
        if (late < 0) late = 0;
      }
    }
    late /= r->quantum;
    lost |= !(late < LONGEST);
    if (lost && !r->zero) continue;
    whole fine = lost ? r->nominal[w] * ONE : (whole)rint(late * ONE), at = sent * ONE + fine;
    whole tick = quotient_up(quotient_up(at, ONE) - r->first_tick, r->tick_period);
    if (tick < r->heard) tick = r->heard;
    if (tick - r->heard >= r->buckets) return 1;
    int32_t *head = r->heads + tick % r->buckets, id = (int32_t)(2 * (slot * r->ways + w) + lost);
    r->next[slot * r->ways + w] = *head;
    *head = id;
    if (r->when && !lost) r->when[slot * r->ways + w] = at;
  }
  return 0;
}

/* Bring in effect what a tick is the first to see. `newest` is the number of the packet sent last. */
static void deliver(const Plan *plan, Route *r, whole tick, whole newest) {
  for (; r->heard <= tick; r->heard++) {
    int32_t *head = r->heads + r->heard % r->buckets, id = *head;
    *head = -1;
    for (; id >= 0; id = r->next[id >> 1]) {
      whole slot = (id >> 1) / r->ways, w = (id >> 1) % r->ways;
      whole number = newest - ((newest - slot) % r->kept + r->kept) % r->kept;
      if (id & 1) {
        if (number > r->gap[w]) r->gap[w] = number;
        continue;
      }
      if (r->newest ? number < r->effective[w]
                    : r->when[slot * r->ways + w] < r->arrived[w] ||
                        (r->when[slot * r->ways + w] == r->arrived[w] && number < r->effective[w]))
        continue;
      r->effective[w] = number;
      if (!r->newest) r->arrived[w] = r->when[slot * r->ways + w];
      whole kept = (number / r->slots) % plan->frames_kept;
      for (whole c = 0; c < r->channels; c++)
        r->held[c * r->ways + w] =
          plan->packets[(kept * plan->keys + r->keys[c * r->slots + number % r->slots]) * plan->peers + r->columns[w]];
    }
  }
}

static inline const double *packet(const Plan *plan, whole frame, whole key, whole lag) {
  return plan->packets + ((frame + plan->frames_kept - lag) % plan->frames_kept * plan->keys + key) * plan->peers;
}

static inline int missing(const Route *r, whole w) { return r->zero && r->gap[w] > r->effective[w]; }

/* A sum in four lanes: of many terms the next need not wait for the last. */
static double sum(const double *values, whole count) {
  double lanes[4] = {0, 0, 0, 0};
  whole i = 0;
  for (; i + 4 <= count; i += 4)
    for (int k = 0; k < 4; k++) lanes[k] += values[i + k];
  for (int k = 0; i < count; i++, k++) lanes[k] += values[i];
  return (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
}

static void on_ways(const Operation *o, const Route *r, double *heard, whole count) {
  const double *held = r->held + o->d * r->ways;
  for (whole i = 0; i < count; i++) {
    whole begin = o->p[i], end = o->p[i + 1];
    double total = 0;
    if (!o->e && !r->zero && o->f) { /* equal weights of ways that stand side by side */
      heard[i] = end > begin ? o->x * sum(held + o->q[begin], end - begin) : 0;
      continue;
    }
    for (whole k = begin; k < end; k++) {
      whole w = o->q[k];
      int gone = missing(r, w);
      total += o->u[k] * (o->e ? (double)gone : gone ? 0.0 : held[w]);
    }
    heard[i] = total;
  }
}

LIBRARY int play(Plan *plan, whole first, whole count, double *rows, double *work) {
  for (whole n = 0; n < count; n++) {
    whole frame = first + n;
    double *own = rows + n * plan->marks * plan->width;
    for (whole i = 0; i < plan->routes; i++)
      for (whole slot = 0; slot < plan->route[i].slots; slot++)
        if (draw(plan->route + i, frame * plan->route[i].slots + slot)) return 1;
    for (const Operation *o = plan->operation; o < plan->operation + plan->operations; o++) {
      switch (o->kind) {
        case TOTAL: { /* a: place, b: key, c: lag, d: how many ranges p */
          const double *row = packet(plan, frame, o->b, o->c);
          double total = 0;
          for (whole i = 0; i < o->d; i++) total += sum(row + o->p[2 * i], o->p[2 * i + 1] - o->p[2 * i]);
          plan->totals[o->a] = total;
          break;
        }
        case COMPLETE: { /* a: member, b: total, c: key or -1, d: lag, x: divisor, v: to */
          const Member *m = plan->member + o->a;
          double total = plan->totals[o->b], *heard = o->v;
          const double *row = o->c < 0 ? 0 : packet(plan, frame, o->c, o->d) + m->column;
          if (!row)
            for (whole i = 0; i < m->count; i++) heard[i] = total / o->x;
          else
            LANES for (whole i = 0; i < m->count; i++) heard[i] = (total - row[i]) / o->x;
          break;
        }
        case WEIGHED: { /* a: member, b: key, c: lag, p: starts, q: columns, u: weights, v: to */
          const double *row = packet(plan, frame, o->b, o->c);
          for (whole i = 0; i < plan->member[o->a].count; i++) {
            double total = 0;
            for (whole k = o->p[i]; k < o->p[i + 1]; k++) total += o->u[k] * row[o->q[k]];
            o->v[i] = total;
          }
          break;
        }
        case DELIVER: { /* a: route, b: tick */
          Route *r = plan->route + o->a;
          deliver(plan, r, frame * r->ticks + o->b, (frame + 1) * r->slots - 1);
          break;
        }
        case ON_WAYS: /* a: member, b: route, d: channel, e: gap, f: x is every weight; p, q, u, v as above */
          on_ways(o, plan->route + o->b, o->v, plan->member[o->a].count);
          break;
        case COPY: { /* a: key, b: lag, c: from, d: how many, v: to */
          memcpy(o->v, packet(plan, frame, o->a, o->b) + o->c, (size_t)o->d * sizeof(double));
          break;
        }
        case COPY_WAYS: { /* a: route, b: channel, or -1 for what is missing, v: to */
          const Route *r = plan->route + o->a;
          for (whole w = 0; w < r->ways; w++) {
            int gone = missing(r, w);
            o->v[w] = o->b < 0 ? (double)gone : gone ? 0.0 : r->held[o->b * r->ways + w];
          }
          break;
        }
        case LOOK: { /* a: member, b: function, c: arcs, d: operator, e: width, f: rows of what is heard, g: now;
                        p: senders, q: receivers, then (address, stride) of its own rows; u: weights;
                        v: what is heard, then what is missing; w: to; y / z: seconds a quantum */
          double t = ((double)frame * (double)plan->frame + (double)o->g) * o->y / o->z;
          const Member *m = plan->member + o->a;
          looks[o->b](o->c, o->p, o->q, o->u, (int)o->d, o->q + o->c, o->w, m->count, o->v,
                      o->e, o->v + o->f * o->e, t);
          break;
        }
        case MOVE: { /* a: member, b: kernel, c: first mark, d: first column of rows, e: first impulse, p: keys */
          const Member *m = plan->member + o->a;
          double *sent = plan->packets + frame % plan->frames_kept * plan->keys * plan->peers + m->column;
          const double *impulses = m->impulses + (n * m->impulse_rows + o->e) * m->sites;
          kernels[o->b](m->count, m->carry, m->heard, m->constants, (int)m->own, impulses, m->sites, m->site,
                        (double)frame, sent, o->p, plan->peers, own + o->c * plan->width + o->d, plan->width);
          break;
        }
        case WORK: /* a: member, b: part, c: row of the carry */
          work[n * plan->parts + o->b] += sum(plan->member[o->a].carry + o->c * plan->member[o->a].count,
                                              plan->member[o->a].count);
          break;
      }
    }
  }
  return 0;
}
