/* How a simulator calls it: FMI 2.0 for co-simulation (fmi-standard.org).

Before this text stand `model`, `begin`, `run`, `real`, `flag`, `given`, `moving`, QUANTA and SECONDS (a quantum is SECONDS/QUANTA
s), and GUID. An instant is over when a step that begins with it has begun: what is heard at it can be set
until then. A time between two instants shows what was last.
*/
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define FMI __declspec(dllexport)
#else
#define FMI __attribute__((visibility("default")))
#endif

typedef void *fmi2Component;
typedef void *fmi2ComponentEnvironment;
typedef void *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef char fmi2Char;
typedef const fmi2Char *fmi2String;
typedef char fmi2Byte;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef struct {
  void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
  void *(*allocateMemory)(size_t, size_t);
  void (*freeMemory)(void *);
  void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
  fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

typedef struct {
  model model;
  double begun, time; /* in s: of the experiment's start, and now */
  int running; /* once the topology has begun, states can't be set */
  char name[256];
  const fmi2CallbackFunctions *functions;
} Instance;

static fmi2Status complain(const Instance *c, const char *what) {
  if (c->functions && c->functions->logger)
    c->functions->logger(c->functions->componentEnvironment, c->name, fmi2Error, "logStatusError", "%s", what);
  return fmi2Error;
}

/* The last instant until a time, in quanta; a time that rounding left just before an instant means it. */
static long long instant(double seconds) {
  const double quanta = seconds * QUANTA / SECONDS;
  const long long found = (long long)quanta;
  return found + (quanta - (double)found > 0.99);
}

FMI const char *fmi2GetTypesPlatform(void) { return "default"; }

FMI const char *fmi2GetVersion(void) { return "2.0"; }

FMI fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count, const fmi2String categories[]) {
  (void)c;
  (void)on;
  (void)count;
  (void)categories;
  return fmi2OK;
}

FMI fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                  const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
  Instance *c = 0;
  (void)resources;
  (void)visible;
  (void)logging;
  if (type != fmi2CoSimulation || !guid || strcmp(guid, GUID) != 0) return 0;
  c = calloc(1, sizeof *c);
  if (!c) return 0;
  if (name) strncpy(c->name, name, sizeof c->name - 1);
  c->functions = functions;
  begin(&c->model);
  return c;
}

FMI void fmi2FreeInstance(fmi2Component c) { free(c); }

FMI fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_given, fmi2Real tolerance, fmi2Real start,
                                   fmi2Boolean stop_given, fmi2Real stop) {
  Instance *instance_of = c;
  (void)tolerance_given;
  (void)tolerance;
  (void)stop_given;
  (void)stop;
  instance_of->begun = instance_of->time = start;
  return fmi2OK;
}

FMI fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
  (void)c;
  return fmi2OK;
}

FMI fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
  Instance *instance_of = c;
  instance_of->running = 1;
  run(&instance_of->model, 0);
  return fmi2OK;
}

FMI fmi2Status fmi2Terminate(fmi2Component c) {
  (void)c;
  return fmi2OK;
}

FMI fmi2Status fmi2Reset(fmi2Component c) {
  Instance *instance_of = c;
  begin(&instance_of->model);
  instance_of->begun = instance_of->time = 0;
  instance_of->running = 0;
  return fmi2OK;
}

FMI fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference which[], size_t count, fmi2Real values[]) {
  Instance *instance_of = c;
  for (size_t i = 0; i < count; i++) {
    const double *value = real(&instance_of->model, which[i]);
    if (!value) return complain(instance_of, "no number of this value reference");
    values[i] = *value;
  }
  return fmi2OK;
}

FMI fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference which[], size_t count, const fmi2Real values[]) {
  Instance *instance_of = c;
  for (size_t i = 0; i < count; i++) {
    const int settable = given(which[i]) || (!instance_of->running && moving(which[i]));
    double *value = settable ? real(&instance_of->model, which[i]) : 0;
    if (!value) return complain(instance_of, "no number that can be set has this value reference");
    *value = values[i];
  }
  return fmi2OK;
}

FMI fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference which[], size_t count, fmi2Boolean values[]) {
  Instance *instance_of = c;
  for (size_t i = 0; i < count; i++) {
    const int *value = flag(&instance_of->model, which[i]);
    if (!value) return complain(instance_of, "no flag of this value reference");
    values[i] = *value;
  }
  return fmi2OK;
}

FMI fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference which[], size_t count,
                              const fmi2Boolean values[]) {
  Instance *instance_of = c;
  for (size_t i = 0; i < count; i++) {
    int *value = flag(&instance_of->model, which[i]);
    if (!value) return complain(instance_of, "no flag of this value reference");
    *value = values[i] != 0;
  }
  return fmi2OK;
}

/* There are none of these. */
static fmi2Status none(fmi2Component c, size_t count) {
  return count ? complain(c, "there is no variable of this type") : fmi2OK;
}

FMI fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference which[], size_t count, fmi2Integer values[]) {
  (void)which;
  (void)values;
  return none(c, count);
}

FMI fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference which[], size_t count,
                              const fmi2Integer values[]) {
  (void)which;
  (void)values;
  return none(c, count);
}

FMI fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference which[], size_t count, fmi2String values[]) {
  (void)which;
  (void)values;
  return none(c, count);
}

FMI fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference which[], size_t count,
                             const fmi2String values[]) {
  (void)which;
  (void)values;
  return none(c, count);
}

FMI fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
  if (!*state) *state = malloc(sizeof(Instance));
  if (!*state) return complain(c, "there is no memory for a state");
  memcpy(*state, c, sizeof(Instance));
  return fmi2OK;
}

FMI fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
  Instance *instance_of = c;
  const Instance *other = state;
  instance_of->model = other->model;
  instance_of->begun = other->begun;
  instance_of->time = other->time;
  return fmi2OK;
}

FMI fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
  (void)c;
  free(*state);
  *state = 0;
  return fmi2OK;
}

FMI fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
  (void)c;
  (void)state;
  *size = sizeof(Instance);
  return fmi2OK;
}

FMI fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
  if (size < sizeof(Instance)) return complain(c, "a state takes more bytes");
  memcpy(bytes, state, sizeof(Instance));
  return fmi2OK;
}

FMI fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
  if (size != sizeof(Instance)) return complain(c, "a state takes another number of bytes");
  if (!*state) *state = malloc(sizeof(Instance));
  if (!*state) return complain(c, "there is no memory for a state");
  memcpy(*state, bytes, sizeof(Instance));
  return fmi2OK;
}

FMI fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t unknowns,
                                            const fmi2ValueReference known[], size_t knowns, const fmi2Real by[],
                                            fmi2Real values[]) {
  (void)unknown;
  (void)unknowns;
  (void)known;
  (void)knowns;
  (void)by;
  (void)values;
  return complain(c, "there are no directional derivatives");
}

FMI fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference which[], size_t count,
                                           const fmi2Integer order[], const fmi2Real values[]) {
  (void)which;
  (void)order;
  (void)values;
  return none(c, count);
}

FMI fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference which[], size_t count,
                                            const fmi2Integer order[], fmi2Real values[]) {
  (void)which;
  (void)order;
  (void)values;
  return none(c, count);
}

FMI fmi2Status fmi2DoStep(fmi2Component c, fmi2Real at, fmi2Real step, fmi2Boolean keep) {
  Instance *instance_of = c;
  (void)keep;
  if (!(step >= 0)) return complain(instance_of, "a step goes forward");
  instance_of->time = at + step;
  run(&instance_of->model, instant(instance_of->time - instance_of->begun));
  return fmi2OK;
}

FMI fmi2Status fmi2CancelStep(fmi2Component c) { return complain(c, "every step is done when the call returns"); }

FMI fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
  (void)c;
  (void)kind;
  *value = fmi2OK;
  return fmi2Discard;
}

FMI fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
  const Instance *instance_of = c;
  if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
  *value = instance_of->time;
  return fmi2OK;
}

FMI fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
  (void)c;
  (void)kind;
  (void)value;
  return fmi2Discard;
}

FMI fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
  (void)c;
  if (kind != fmi2Terminated) return fmi2Discard;
  *value = 0;
  return fmi2OK;
}

FMI fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
  (void)c;
  (void)kind;
  (void)value;
  return fmi2Discard;
}
