% include "title.c"
/* Reads, a row an instant: ${read | map("last") | join(", ") | comment or "a line of any text"}.
   Prints: time, ${shown | map("last") | join(", ") | comment}. */
#include "${include}"
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

int main(int count, char **words) {
  ${name} peer;
  ${name}_in in = {0};
  ${name}_out out = {0};
  ${name}_start(&peer);
  ${name}_clear(&in);
  if (count > 1) {
    const long ticks = atol(words[1]);
    const clock_t begin = clock();
    for (long k = 0; k < ticks; k++) ${name}_tick(&peer, &in, &out);
    printf("%g s an instant\n", (double)(clock() - begin) / CLOCKS_PER_SEC / (double)ticks);
    return 0;
  }
  while ({% for form, local, label in read %}scanf("${form}", &in.${local}) == 1${" &&\n      " if not loop.last else ""}{% else %}!feof(stdin) && scanf("%*[^\n]") != EOF && getchar() != EOF{% endfor %}) {
    printf("%.17g", ${name}_time(&peer));
    ${name}_tick(&peer, &in, &out);
% for form, local, label in shown
    printf(" ${form}", ${local});
% endfor
    printf("\n");
    fflush(stdout);
  }
  return 0;
}
