% include "topology.c"

% for type, what, flag in [("double", "real", false), ("int", "flag", true)]
static ${type} *${what}(model *m, unsigned which) {
  (void)m;
  switch (which) {
% for item in topology.variables
% if (item.role == "flag") == flag
    case ${loop.index0}: return &m->${item.member};
% endif
% endfor
    default: return 0;
  }
}

% endfor
/* Whether it comes from outside: such numbers are the first. */
static int given(unsigned which) {
  (void)which;
  return ${"which < %du" % inputs if inputs else 0};
}

/* Whether it is a state or a parameter, which can be set until the topology begins. */
static int moving(unsigned which) {
  switch (which) {
% for item in topology.variables
% if item.role in ("state", "parameter")
    case ${loop.index0}: return 1;
% endif
% endfor
    default: return 0;
  }
}

#define QUANTA ${topology.quantum.denominator | float}
#define SECONDS ${topology.quantum.numerator | float}
#define GUID "${guid}"

% include "fmi2.c"
