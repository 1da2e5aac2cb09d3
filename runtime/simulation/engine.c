/* Plays frames of all peers: what `hearing` lists, between the kernels of the members' segments.

The kernels and `luck.c` stand before this text (see `machine`), which also says what every field is. All fields have 8
bytes; addresses are those of NumPy's arrays, which outlive a call. A row of a packet, a carry or what is
heard is contiguous: a number a peer; what is in effect is a number a way.
*/

enum { COMPLETE, WEIGHED, DELIVER, LOOK, MOVE, WORK };

typedef struct {
  whole ways, slots, ticks, phase, period, first_tick, tick_period, kept, buckets, newest, zero, channels;
  whole distribution, traced, stride;
  double p, r, one_minus_h, one_minus_k, bad_share, jitter, quantum;
  const double *trace, *delays;                   /* (traced,); of each way, in seconds */
  const whole *nominal, *senders, *receivers;     /* of each way: quanta, peers of the scene */
  const int32_t *columns;                         /* of each way's sender */
  const whole *keys;                              /* (channels, slots) */
  double *held;                                   /* (channels + 1, ways): what is in effect, where it is missing */
  whole *effective, *gap;                         /* (ways,): numbers */
  int8_t *bad;                                    /* (ways,) */
  int32_t *heads, *queue;                         /* (buckets,), (kept, stride): packets by their tick, run by run: the
                                                     tick's next run, then its packets as TAG says */
  int32_t *when, *places;                         /* (ways,), (buckets,) zeros: while packets are drawn */
  whole *arrived, *waits;                         /* (ways,), (kept, ways), where the order of arrival
                                                     matters: the tick that saw what is in effect; from its arrival
                                                     to its tick, in parts of a quantum */
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
  double *v;
  const double *r;
} Operation;

typedef struct {
  whole frames_kept, keys, peers, operations, routes, marks, width, parts, frame;
  double *packets;
  Operation *operation;
  Route *route;
  Member *member;
} Plan;

#define START (-1)

/* Quotients of what mostly fits 32 bits, in which dividing takes a fraction of the time; none is negative. */
static inline whole quotient(whole a, whole b) {
  return (a | b) >> 32 ? a / b : (whole)((uint32_t)a / (uint32_t)b);
}

enum { LAST = 1, LOST = 2, TAG = 4 }; /* a packet in the queue is TAG · way, + LOST, + LAST of its run */
enum { BLOCK = 256 };                 /* ways whose chances are drawn before they are looked at */

/* Draw the chances of some ways from `begin` on. */
static void draw_chances(const Route *r, whole number, whole begin, whole some, double (*u)[4]) {
  whole senders[SIDE], receivers[SIDE];
  uint64_t keys[SIDE];
  for (whole i = 0; i < some; i += SIDE) {
    for (int k = 0; k < SIDE; k++) {
      whole way = begin + (i + k < some ? i + k : some - 1);
      senders[k] = r->senders[way], receivers[k] = r->receivers[way], keys[k] = r->key[1];
    }
    chances(SIDE, r->key[0], keys, number, senders, receivers, u + i);
  }
}

/* Send packet `number` of every way: draw its luck and put it where the tick that first sees it will look. */
static int draw(Route *r, whole number) {
  whole slot = number % r->kept, sent = r->phase + r->period * number, all = r->ways;
  whole base = sent - r->first_tick - r->heard * r->tick_period, most = r->buckets * r->tick_period;
  whole bucket = r->heard % r->buckets, first = r->buckets, last = -1;
  int chance = !r->traced && (r->jitter > 0 || r->bad_share > 0 || r->one_minus_k > 0 || r->p > 0);
  double u[BLOCK][4];
  const double jitter = r->jitter, quantum = r->quantum, good = r->one_minus_k, ill = r->one_minus_h;
  const double worse = r->p, stays = 1 - r->r, *delays = r->delays;
  const whole zero = r->zero, buckets = r->buckets, tick = r->tick_period, traced = r->traced;
  int32_t *when = r->when, *places = r->places;
  int8_t *is_bad = r->bad; /* what is written there might be any field, as far as a compiler knows: hence all these */
  for (whole w = 0; w < all; w++) {
    const double *own = u[w % BLOCK];
    double late;
    int lost = 0;
    when[w] = -1;
    if (traced) late = r->trace[number % traced];
    else {
      if (w % BLOCK == 0) {
        whole some = all - w < BLOCK ? all - w : BLOCK;
        if (number == 0) {
          draw_chances(r, 1, w, some, u);
          for (whole i = 0; i < some; i++) is_bad[w + i] = u[i][0] < r->bad_share;
        }
        if (chance) draw_chances(r, number + 2, w, some, u);
      }
      late = delays[w];
      if (chance) {
        int bad = is_bad[w];
        lost = own[1] < (bad ? ill : good);
        is_bad[w] = bad ? own[0] < stays : own[0] < worse;
        if (jitter > 0) {
          late += jitter * deviate(r->distribution, own[2], own[3]);
          if (late < 0) late = 0;
        }
      }
    }
    late /= quantum;
    lost |= !(late < LONGEST);
    if (lost && !zero) continue;
    whole fine = lost ? r->nominal[w] * ONE : (whole)rint(late * ONE);
    whole since = base + (fine + ONE - 1) / ONE; /* since the tick that is heard next */
    whole ticks = since > 0 ? quotient(since + tick - 1, tick) : 0;
    if (since > most || ticks >= buckets) return 1;
    if (ticks < first) first = ticks;
    if (ticks > last) last = ticks;
    places[ticks]++;
    when[w] = (int32_t)(2 * ticks + lost);
    if (!r->newest && !lost)
      r->waits[slot * all + w] = (ticks * tick - since) * ONE + (ONE - fine % ONE) % ONE;
  }
  int32_t at = (int32_t)(slot * r->stride);
  for (whole ticks = first; ticks <= last; ticks++) {
    int32_t count = places[ticks], *head = r->heads + (bucket + ticks) % buckets;
    if (!count) continue;
    r->queue[at] = *head;
    *head = at++;
    places[ticks] = at;
    at += count;
  }
  for (whole w = 0; w < all; w++)
    if (when[w] >= 0) r->queue[places[when[w] >> 1]++] = (int32_t)(TAG * w + (when[w] & 1 ? LOST : 0));
  for (whole ticks = first; ticks <= last; ticks++) {
    if (places[ticks]) r->queue[places[ticks] - 1] |= LAST;
    places[ticks] = 0;
  }
  return 0;
}

/* Say whether a packet arrived before the one in effect, or with it but sent before; both since the last tick. */
static inline int is_before(const Route *r, whole w, whole number) {
  const whole all = r->ways, other = r->effective[w];
  whole wait = r->waits[number % r->kept * all + w], its = r->waits[other % r->kept * all + w];
  return wait > its || (wait == its && number < other);
}

/* Bring in effect what a tick is the first to see. `newest` is the number of the packet sent last. */
static void deliver(const Plan *plan, Route *r, whole tick, whole newest) {
  whole all = r->ways, newest_slot = newest % r->kept, frame = newest / r->slots % plan->frames_kept;
  for (; r->heard <= tick; r->heard++) {
    int32_t *head = r->heads + r->heard % r->buckets, at = *head;
    *head = -1;
    while (at >= 0) { /* a run: packets sent together */
      whole slot = quotient(at, r->stride), ago = newest_slot - slot + (slot > newest_slot ? r->kept : 0);
      whole number = newest - ago, frames_ago = quotient(ago, r->slots), kept = frame - frames_ago;
      const whole *keys = r->keys + r->slots - 1 - (ago - frames_ago * r->slots);
      if (kept < 0) kept += plan->frames_kept;
      int32_t next = r->queue[at], id;
      do {
        id = r->queue[++at];
        whole w = id / TAG;
        if (id & LOST) {
          if (number > r->gap[w]) r->gap[w] = number;
          continue;
        }
        if (r->newest) {
          if (number < r->effective[w]) continue;
        } else {
          if (r->arrived[w] == r->heard && is_before(r, w, number)) continue;
          r->arrived[w] = r->heard;
        }
        r->effective[w] = number;
        for (whole c = 0; c < r->channels; c++)
          r->held[c * all + w] =
            plan->packets[(kept * plan->keys + keys[c * r->slots]) * plan->peers + r->columns[w]];
      } while (!(id & LAST));
      at = next;
    }
  }
  if (!r->zero) return;
  for (whole w = 0; w < all; w++) { /* what is missing stays so until a newer packet comes, which is written anew */
    int gone = r->gap[w] > r->effective[w];
    r->held[r->channels * all + w] = gone;
    if (gone)
      for (whole c = 0; c < r->channels; c++) r->held[c * all + w] = 0;
  }
}

static inline const double *packet(const Plan *plan, whole frame, whole key, whole lag) {
  return plan->packets + ((frame + plan->frames_kept - lag) % plan->frames_kept * plan->keys + key) * plan->peers;
}

/* A sum in four lanes: of many terms the next need not wait for the last. */
static double sum(const double *values, whole count) {
  double lanes[4] = {0, 0, 0, 0};
  whole i = 0;
  for (; i + 4 <= count; i += 4)
    for (int k = 0; k < 4; k++) lanes[k] += values[i + k];
  for (int k = 0; i < count; i++, k++) lanes[k] += values[i];
  return (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
}

/* What an operation reads: a packet, or, if its key is -1, what stands at an address. */
static inline const double *source(const Plan *plan, whole frame, whole key, whole lag, const double *address) {
  return key < 0 ? address : packet(plan, frame, key, lag);
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
        case COMPLETE: { /* a: member, b: key, c: lag, d: how many ranges p, e: its own is left out, x: divisor, v: to */
          const Member *m = plan->member + o->a;
          const double *row = packet(plan, frame, o->b, o->c), *own = row + m->column, divisor = o->x;
          const whole count = m->count;
          double total = 0, *heard = o->v;
          for (whole i = 0; i < o->d; i++) total += sum(row + o->p[2 * i], o->p[2 * i + 1] - o->p[2 * i]);
          if (o->e)
            LANES for (whole i = 0; i < count; i++) heard[i] = (total - own[i]) / divisor;
          else
            LANES for (whole i = 0; i < count; i++) heard[i] = total / divisor;
          break;
        }
        case WEIGHED: { /* a: member, b: key, c: lag, r: address, p: starts, q: columns, u: weights, v: to */
          const double *row = source(plan, frame, o->b, o->c, o->r);
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
        case LOOK: { /* a: member, b: function, c: arcs, d: operator, e: first, f: sources, g: now, x: own rows;
                        p: senders, q: receivers, then (address, stride) of its own rows, then the sources' (key, lag,
                        address); u: weights; r: what is missing, or 0; v: to; y / z: seconds a quantum */
          double t = ((double)frame * (double)plan->frame + (double)o->g) * o->y / o->z;
          const whole *own = o->q + o->c, *from = own + 2 * (whole)o->x;
          const double *sent[o->f + 1];
          for (whole k = 0; k < o->f; k++)
            sent[k] = source(plan, frame, from[3 * k], from[3 * k + 1], (const double *)from[3 * k + 2]);
          looks[o->b](o->c, o->p, o->q, o->u, (int)o->d, (int)o->e, own, o->v, plan->member[o->a].count, sent, o->r, t);
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
