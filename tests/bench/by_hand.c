// What an expert writes for equal peers: a frame of a peer in registers, the peers in lanes.
// P, Q, R and S are the states after a tick, from the states a to d and the forces f_now and g_now.
#include <stdint.h>
__attribute__((target_clones("avx2", "default")))
void play(int64_t n, int64_t frames, double *restrict x, double *restrict v, double *restrict y, double *restrict w,
          double *restrict contact, double *restrict pull, double *restrict sent, double *restrict heard) {
  for (int64_t frame = 0; frame < frames; frame++) {
    double lanes[8] = {0};
    for (int64_t i = 0; i < n; i++) heard[i] = sent[i], sent[i] = y[i];
    for (int64_t i = 0; i < n; i += 8)
      for (int64_t k = 0; k < 8 && i + k < n; k++) lanes[k] += heard[i + k];
    double total = 0;
    for (int k = 0; k < 8; k++) total += lanes[k];
    #pragma GCC ivdep
    for (int64_t i = 0; i < n; i++) {
      double a = x[i], b = v[i], c = y[i], d = w[i], f = contact[i], g = pull[i], others = (total - heard[i]) / (n - 1);
      #pragma GCC unroll 8
      for (int tick = 0; tick < TICKS; tick++) {
        double f_now = f, g_now = g;
        f = K_C * (a - c);
        g = K_T * (c - others);
        double p = P, q = Q, r = R, s = S;
        a = p; b = q; c = r; d = s;
      }
      x[i] = a; v[i] = b; y[i] = c; w[i] = d; contact[i] = f; pull[i] = g;
    }
  }
}
