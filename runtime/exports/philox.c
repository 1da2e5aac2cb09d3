/* Random packet losses and delays, as `network.channel` has it: whole is int64_t. */

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

/* Philox-4x64-10, as NumPy's, see `network.channel`: numbers from 0 to less than 1 of so many ways at once, at most SIDE, each
   with its second word of the key. A number's rounds wait for one another, those of several ways do not. */
#define SIDE 4
static inline void chances(const int ways, uint64_t key, const uint64_t *keys, whole block, const whole *senders,
                           const whole *receivers, double (*u)[4]) {
  uint64_t one[SIDE], two[SIDE], three[SIDE], four[SIDE], second[SIDE];
  for (int k = 0; k < ways; k++) {
    one[k] = block, two[k] = senders[k], three[k] = receivers[k], four[k] = 0, second[k] = keys[k];
  }
  for (int turn = 0; turn < 10; turn++) {
    for (int k = 0; k < ways; k++) {
      uint64_t low, other_low;
      uint64_t upper = high(0xD2E7470EE14C6C93u, one[k], &low);
      uint64_t other = high(0xCA5A826395121157u, three[k], &other_low);
      one[k] = other ^ two[k] ^ key;
      two[k] = other_low;
      three[k] = upper ^ four[k] ^ second[k];
      four[k] = low;
      second[k] += 0xBB67AE8584CAA73Bu;
    }
    key += 0x9E3779B97F4A7C15u;
  }
  for (int k = 0; k < ways; k++) {
    u[k][0] = (one[k] >> 11) * 0x1p-53;
    u[k][1] = (two[k] >> 11) * 0x1p-53;
    u[k][2] = (three[k] >> 11) * 0x1p-53;
    u[k][3] = (four[k] >> 11) * 0x1p-53;
  }
}

static inline double deviate(whole distribution, double one, double two) {
  if (distribution == UNIFORM) return 2 * one - 1;
  if (distribution == NORMAL) return sqrt(-2 * log1p(-one)) * cos(6.283185307179586 * two);
  double late = (pow(1 - one, -1.0 / 3) - 1.5) * 4 / 3;
  return late < 4 ? late : 4;
}
