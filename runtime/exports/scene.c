$includes
#include <limits.h>
$luck
typedef struct {
$members} model;

$links$sites
static void begin(model *m) {
$begin}

static void run(model *m, long long until) {
  for (;;) {
    long long at = LLONG_MAX;
$next    if (at > until) return;
$move$send    if (at == until) return;
$force  }
}
