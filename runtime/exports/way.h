
typedef struct {
  long long due, number; /* when it is there, in 2^-20 quanta, and which it is */
  int state;             /* 0 there is none, 1 it comes, 2 it is lost */
} ${own}_coming;

typedef struct {
  double held[$channels]; /* what is in effect */
  long long effective, gap, arrived; /* its number; the newest that is missed; when it came */
  int bad;
  ${own}_coming coming[$kept];
} ${own}_way;
