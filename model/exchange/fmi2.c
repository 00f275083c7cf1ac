/* FMI 2.0 for co-simulation and model exchange around equations.h, which is written by Sprung for one system.
   equations.h gives NX states, NU inputs, NY outputs, NP parameters, GUID, INTERNAL_STEP, defaults, derivatives()
   and outputs().  Value references: parameters, inputs, outputs, states, derivatives, one after the other. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef void *fmi2Component;
typedef void *fmi2ComponentEnvironment;
typedef void *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef char fmi2Char;
typedef char fmi2Byte;
typedef const fmi2Char *fmi2String;
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
  fmi2Boolean newDiscreteStatesNeeded, terminateSimulation, nominalsOfContinuousStatesChanged;
  fmi2Boolean valuesOfContinuousStatesChanged, nextEventTimeDefined;
  fmi2Real nextEventTime;
} fmi2EventInfo;

#include "equations.h"

#define AT_INPUTS NP
#define AT_OUTPUTS (NP + NU)
#define AT_STATES (NP + NU + NY)
#define AT_DERIVATIVES (NP + NU + NY + NX)
#define COUNT (NP + NU + NY + 2 * NX)
#define ROOM(n) ((n) > 0 ? (n) : 1)

typedef struct {
  double time, p[ROOM(NP)], u[ROOM(NU)], slope[ROOM(NU)], x[ROOM(NX)];
} Instance;

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

static void start(Instance *m) {
  memset(m, 0, sizeof *m);
  memcpy(m->p, defaults, sizeof(double) * NP);
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[]) {
  (void)c, (void)on, (void)n, (void)names;
  return fmi2OK;
}

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                     const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
  (void)name, (void)type, (void)resources, (void)functions, (void)visible, (void)logging;
  if (!guid || strcmp(guid, GUID) != 0) return NULL;
  Instance *m = malloc(sizeof *m);
  if (m) start(m);
  return m;
}
EXPORT void fmi2FreeInstance(fmi2Component c) { free(c); }
EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real begin,
                                      fmi2Boolean has_stop, fmi2Real stop) {
  (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
  ((Instance *)c)->time = begin;
  return fmi2OK;
}
EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
EXPORT fmi2Status fmi2Terminate(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
EXPORT fmi2Status fmi2Reset(fmi2Component c) {
  start(c);
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
  Instance *m = c;
  double y[ROOM(NY)], dx[ROOM(NX)];
  int have_y = 0, have_dx = 0;
  for (size_t i = 0; i < n; i++) {
    unsigned at = vr[i];
    if (at < AT_INPUTS) value[i] = m->p[at];
    else if (at < AT_OUTPUTS) value[i] = m->u[at - AT_INPUTS];
    else if (at < AT_STATES) {
      if (!have_y) outputs(m->time, m->x, m->u, m->p, y), have_y = 1;
      value[i] = y[at - AT_OUTPUTS];
    } else if (at < AT_DERIVATIVES) value[i] = m->x[at - AT_STATES];
    else if (at < COUNT) {
      if (!have_dx) derivatives(m->time, m->x, m->u, m->p, dx), have_dx = 1;
      value[i] = dx[at - AT_DERIVATIVES];
    } else return fmi2Error;
  }
  return fmi2OK;
}
EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
  Instance *m = c;
  for (size_t i = 0; i < n; i++) {
    unsigned at = vr[i];
    if (at < AT_INPUTS) m->p[at] = value[i];
    else if (at < AT_OUTPUTS) m->u[at - AT_INPUTS] = value[i];
    else if (at >= AT_STATES && at < AT_DERIVATIVES) m->x[at - AT_STATES] = value[i];
    else return fmi2Error;
  }
  return fmi2OK;
}
#define NONE(function, type)                                                                        \
  EXPORT fmi2Status function(fmi2Component c, const fmi2ValueReference vr[], size_t n, type value[]) { \
    (void)c, (void)vr, (void)value;                                                                 \
    return n ? fmi2Error : fmi2OK;                                                                  \
  }
NONE(fmi2GetInteger, fmi2Integer)
NONE(fmi2GetBoolean, fmi2Boolean)
NONE(fmi2GetString, fmi2String)
NONE(fmi2SetInteger, const fmi2Integer)
NONE(fmi2SetBoolean, const fmi2Boolean)
NONE(fmi2SetString, const fmi2String)

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
  if (!*state && !(*state = malloc(sizeof(Instance)))) return fmi2Error;
  memcpy(*state, c, sizeof(Instance));
  return fmi2OK;
}
EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
  memcpy(c, state, sizeof(Instance));
  return fmi2OK;
}
EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
  (void)c;
  free(*state);
  *state = NULL;
  return fmi2OK;
}
EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
  (void)c, (void)state;
  *size = sizeof(Instance);
  return fmi2OK;
}
EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
  (void)c;
  if (size < sizeof(Instance)) return fmi2Error;
  memcpy(bytes, state, sizeof(Instance));
  return fmi2OK;
}
EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
  (void)c;
  if (size < sizeof(Instance) || (!*state && !(*state = malloc(sizeof(Instance))))) return fmi2Error;
  memcpy(*state, bytes, sizeof(Instance));
  return fmi2OK;
}

/* d(unknown)/d(known) along dv by central differences: exact to rounding where the system is linear. */
EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n,
                                               const fmi2ValueReference known[], size_t k, const fmi2Real dv[],
                                               fmi2Real result[]) {
  Instance ahead = *(Instance *)c, behind = ahead;
  double largest = 0.0;
  for (size_t i = 0; i < k; i++) largest = fmax(largest, fabs(dv[i]));
  double h = largest > 0 ? 1e-6 / largest : 1.0;
  double *low = malloc(sizeof(double) * (n ? n : 1));
  if (!low) return fmi2Error;
  for (size_t i = 0; i < k; i++) {
    double value, moved;
    fmi2GetReal(c, &known[i], 1, &value);
    moved = value + h * dv[i];
    fmi2SetReal(&ahead, &known[i], 1, &moved);
    moved = value - h * dv[i];
    fmi2SetReal(&behind, &known[i], 1, &moved);
  }
  fmi2GetReal(&ahead, unknown, n, result);
  fmi2GetReal(&behind, unknown, n, low);
  for (size_t i = 0; i < n; i++) result[i] = (result[i] - low[i]) / (2 * h);
  free(low);
  return fmi2OK;
}

/* model exchange */
EXPORT fmi2Status fmi2EnterEventMode(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
EXPORT fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
  (void)c;
  memset(info, 0, sizeof *info);
  return fmi2OK;
}
EXPORT fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
EXPORT fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_set, fmi2Boolean *event,
                                              fmi2Boolean *end) {
  (void)c, (void)no_set;
  *event = *end = 0;
  return fmi2OK;
}
EXPORT fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
  ((Instance *)c)->time = time;
  return fmi2OK;
}
EXPORT fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
  if (n != NX) return fmi2Error;
  memcpy(((Instance *)c)->x, x, sizeof(double) * NX);
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
  if (n != NX) return fmi2Error;
  memcpy(x, ((Instance *)c)->x, sizeof(double) * NX);
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
  Instance *m = c;
  if (n != NX) return fmi2Error;
  derivatives(m->time, m->x, m->u, m->p, dx);
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
  (void)c;
  for (size_t i = 0; i < n; i++) x[i] = 1.0;
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) {
  (void)c, (void)z, (void)n;
  return fmi2OK;
}

/* co-simulation: Runge-Kutta 4 in steps of at most INTERNAL_STEP, inputs continued with the slopes that were set, and
   displacements of supports, where none was, with their velocity: held, they would jump from step to step */
EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                              const fmi2Integer order[], const fmi2Real value[]) {
  Instance *m = c;
  for (size_t i = 0; i < n; i++) {
    if (order[i] != 1 || vr[i] < AT_INPUTS || vr[i] >= AT_OUTPUTS) return fmi2Error;
    m->slope[vr[i] - AT_INPUTS] = value[i];
  }
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                               const fmi2Integer order[], fmi2Real value[]) {
  (void)c, (void)vr, (void)order, (void)value;
  return n ? fmi2Error : fmi2OK;
}

static void slope_at(const Instance *m, double since, const double *x, double *dx) {
  double u[ROOM(NU)];
  for (int i = 0; i < NU; i++) u[i] = m->u[i] + since * m->slope[i];
  derivatives(m->time + since, x, u, m->p, dx);
}

EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_set) {
  Instance *m = c;
  (void)no_set;
  if (step < 0) return fmi2Error;
  m->time = time;
  int parts = (int)ceil(step / INTERNAL_STEP);
  if (parts < 1) parts = 1;
  for (int i = 0; i < NU; i++)
    if (m->slope[i] == 0.0 && rate_of[i] >= 0) m->slope[i] = m->u[rate_of[i]];
  double h = step / parts, a[ROOM(NX)], b[ROOM(NX)], k[ROOM(NX)], d[ROOM(NX)], at[ROOM(NX)];
  for (int j = 0; j < parts; j++) {
    double since = j * h;
    slope_at(m, since, m->x, a);
    for (int i = 0; i < NX; i++) at[i] = m->x[i] + 0.5 * h * a[i];
    slope_at(m, since + 0.5 * h, at, b);
    for (int i = 0; i < NX; i++) at[i] = m->x[i] + 0.5 * h * b[i];
    slope_at(m, since + 0.5 * h, at, k);
    for (int i = 0; i < NX; i++) at[i] = m->x[i] + h * k[i];
    slope_at(m, since + h, at, d);
    for (int i = 0; i < NX; i++) m->x[i] += h / 6 * (a[i] + 2 * b[i] + 2 * k[i] + d[i]);
  }
  for (int i = 0; i < NU; i++) m->u[i] += step * m->slope[i], m->slope[i] = 0.0;
  m->time = time + step;
  for (int i = 0; i < NX; i++)
    if (!isfinite(m->x[i])) return fmi2Error;
  return fmi2OK;
}
EXPORT fmi2Status fmi2CancelStep(fmi2Component c) {
  (void)c;
  return fmi2Error;
}
EXPORT fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
  (void)c, (void)kind;
  *value = fmi2OK;
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
  (void)kind;
  *value = ((Instance *)c)->time;
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
  (void)c, (void)kind, (void)value;
  return fmi2Discard;
}
EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
  (void)c, (void)kind;
  *value = 0;
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
  (void)c, (void)kind, (void)value;
  return fmi2Discard;
}
