% for code in topology.codes
#include "${code.identifier}.h"
% endfor
#include <limits.h>
% if unreliable
#include <math.h>
#include <stdint.h>

typedef int64_t whole;
% include "philox.c"
% for link in unreliable
% include "arc.h"
% endfor
% endif

typedef struct {
% for code, numbers, links in subsystems
% set s = loop.index0
  ${code.identifier} peer${s}[${numbers | length}];
  ${code.identifier}_in in${s}[${numbers | length}];
  ${code.identifier}_out out${s}[${numbers | length}];
  int stage${s}[${numbers | length}]; /* at an instant: 0 come, 1 what it sends has gone out, 2 done */
% endfor
% for link in topology.links
  double ${link.name}[${link.ring}][${topology.peers | length}][${link.channels | length}]; /* the newest packets */
% if link.arrival_process
  ${link.name}_arc arcs_${link.name}[${link.arcs | length}];
% endif
% endfor
} model;

% for link in topology.links
% include "link.c"
% include ("channel_draw.c" if link.arrival_process else "delay.c")
% endfor
% for code, numbers, links in subsystems
% set s = loop.index0
% include "subsystem.c"
% endfor

static void begin(model *m) {
% for item in subsystems
  begin_${loop.index0}(m);
% endfor
% for link in unreliable
  begin_${link.name}(m);
% endfor
}

static void run(model *m, long long until) {
  for (;;) {
    long long at = LLONG_MAX;
% for item in subsystems
    at = next_${loop.index0}(m, at);
% endfor
    if (at > until) return;
% for verb in ("move", "send")
% for item in subsystems
    ${verb}_${loop.index0}(m, at);
% endfor
% endfor
    if (at == until) return;
% for item in subsystems
    force_${loop.index0}(m, at);
% endfor
  }
}
