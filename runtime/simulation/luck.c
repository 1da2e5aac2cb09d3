/* The luck of packets, as `network.channel` has it: whole is int64_t. */

enum { UNIFORM, NORMAL, PARETO };

#define ONE 1048576 /* an arrival's finest part of a quantum: 2^-20, as in `timetable` */
#define LONGEST 1099511627776.0

static inline uint64_t high(uint64_t a, uint64_t b, uint64_t *low) {
#ifdef __SIZEOF_INT128__
  __extension__ typedef unsigned __int128 wide;
  wide both = (wide)a * b;
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
