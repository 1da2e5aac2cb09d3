$title
/* Reads, a row an instant: $reads.
   Prints: time, $prints. */
#include "$include"
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

int main(int count, char **words) {
  $name peer;
  ${name}_in in = {0};
  ${name}_out out = {0};
  ${name}_start(&peer);
  ${name}_unheard(&in);
  if (count > 1) {
    const long ticks = atol(words[1]);
    const clock_t begin = clock();
    for (long k = 0; k < ticks; k++) ${name}_tick(&peer, &in, &out);
    printf("%g s an instant\n", (double)(clock() - begin) / CLOCKS_PER_SEC / (double)ticks);
    return 0;
  }
  while ($condition) {
    printf("%.17g", ${name}_time(&peer));
    ${name}_tick(&peer, &in, &out);
$shown    printf("\n");
    fflush(stdout);
  }
  return 0;
}
