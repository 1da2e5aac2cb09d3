
typedef struct {
  long long due, number; /* when it is there, in 2^-20 quanta, and which it is */
  int state;             /* 0 there is none, 1 it comes, 2 it is lost */
} ${link.name}_coming;

typedef struct {
  double held[${link.channels | length}]; /* what is in effect */
  long long effective, gap, arrived; /* its number; the newest that is missed; when it came */
  int bad;
  ${link.name}_coming coming[${link.stored}];
} ${link.name}_arc;
