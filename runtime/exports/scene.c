% for code in scene.codes
#include "${code.identifier}.h"
% endfor
#include <limits.h>
% if lucky
#include <math.h>
#include <stdint.h>

typedef int64_t whole;
% include "luck.c"
% for link in lucky
% include "way.h"
% endfor
% endif

typedef struct {
% for code, numbers, links in sites
% set s = loop.index0
  ${code.identifier} peer${s}[${numbers | length}];
  ${code.identifier}_in in${s}[${numbers | length}];
  ${code.identifier}_out out${s}[${numbers | length}];
  int stage${s}[${numbers | length}]; /* at an instant: 0 come, 1 what it sends has gone out, 2 done */
% endfor
% for link in scene.links
  double ${link.name}[${link.ring}][${scene.peers | length}][${link.channels | length}]; /* the newest packets */
% if link.luck
  ${link.name}_way ways_${link.name}[${link.ways | length}];
% endif
% endfor
} model;

% for link in scene.links
% include "link.c"
% include ("chance.c" if link.luck else "delay.c")
% endfor
% for code, numbers, links in sites
% set s = loop.index0
% include "site.c"
% endfor

static void begin(model *m) {
% for one in sites
  begin_${loop.index0}(m);
% endfor
% for link in lucky
  begin_${link.name}(m);
% endfor
}

static void run(model *m, long long until) {
  for (;;) {
    long long at = LLONG_MAX;
% for one in sites
    at = next_${loop.index0}(m, at);
% endfor
    if (at > until) return;
% for verb in ("move", "send")
% for one in sites
    ${verb}_${loop.index0}(m, at);
% endfor
% endfor
    if (at == until) return;
% for one in sites
    force_${loop.index0}(m, at);
% endfor
  }
}
