/* Advances all peers by frames: the exchanges of `exchange_program`, between the kernels of the members' segments.

The kernels precede this text (see `compiled_engine`, which also documents every field). All fields have 8
bytes; addresses are those of NumPy's arrays, which outlive a call. A row of a packet, a carry or a
received value is contiguous: one number per peer. The packets in effect are one number per arc.
*/

enum { COMPLETE, WEIGHED, DELIVER, LOOK, MOVE, WORK };

typedef struct {
  whole ways, slots, ticks, zero, channels;
  const whole *columns;                           /* of each way's sender */
  const whole *keys;                              /* (channels, slots) */
  double *held;                                   /* (channels + 1, ways): what is in effect, where it is missing */
  whole *effective;                               /* (ways,): the packet in effect */
  const whole *seen;                              /* (ticks, ways) of this call: packets, and which are missing */
  const uint8_t *missing;
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
  whole frames_kept, keys, peers, operations, marks, width, parts, frame;
  double *packets;
  Operation *operation;
  Route *route;
  Member *member;
} Plan;

/* Bring in effect what a tick of this call sees. */
static void deliver(const Plan *plan, const Route *r, whole tick) {
  whole all = r->ways;
  for (whole w = 0; w < all; w++) {
    whole number = r->seen[tick * all + w];
    if (number != r->effective[w]) {
      whole kept = number / r->slots % plan->frames_kept;
      const whole *keys = r->keys + number % r->slots;
      r->effective[w] = number;
      for (whole c = 0; c < r->channels; c++)
        r->held[c * all + w] =
          plan->packets[(kept * plan->keys + keys[c * r->slots]) * plan->peers + r->columns[w]];
    }
    if (!r->zero) continue;
    r->held[r->channels * all + w] = r->missing[tick * all + w];
    if (r->missing[tick * all + w]) /* it stays so until a newer packet comes, which is written anew */
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

LIBRARY void play(Plan *plan, whole first, whole count, double *rows, double *work) {
  for (whole n = 0; n < count; n++) {
    whole frame = first + n;
    double *own = rows + n * plan->marks * plan->width;
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
          const Route *r = plan->route + o->a;
          deliver(plan, r, n * r->ticks + o->b);
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
}
