/* $title: the functions of FMI 3.0 for co-simulation, over ${name}_$kind.h.

   Written by drake_dae $version; the terms are in LICENSE.txt. */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "${name}_$kind.h"

#if defined(_WIN32)
#define FMI3 __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI3 __attribute__((visibility("default")))
#else
#define FMI3
#endif

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } Status;
typedef uint32_t Reference;
typedef void (*Log)(void *environment, Status status, const char *category, const char *message);

static const char *const TOKEN = "$token";

$own
/* What a state of the FMU is. */
typedef struct {
  Own own;
  double time;
  enum { INSTANTIATED, INITIALIZATION, STEPS, TERMINATED } mode;
} Data;

typedef struct {
  Data data;
  Log log;
  void *environment;
} Instance;

/* Where variables are: value references first, ..., first + count - 1. */
typedef struct {
  Reference first, count;
  size_t place;
  enum { NEVER, AT_FIRST, ALWAYS } set;
} Range;

static const Range floats[] = {
  {0, 1, offsetof(Data, time), NEVER},
$floats};
static const Range integers[] = {
$integers  {0, 0, 0, NEVER}};

static Status failed(const Instance *instance, const char *message) {
  if (instance->log) instance->log(instance->environment, ERROR, "logStatusError", message);
  return ERROR;
}

static void *find(Instance *instance, const Range *ranges, size_t count, size_t size,
                  Reference reference, bool is_set) {
  size_t i;
  for (i = 0; i < count; i++) {
    const Range *range = ranges + i;
    if (reference - range->first >= range->count) continue;
    if (is_set && range->set == NEVER) return 0;
    if (is_set && range->set == AT_FIRST && instance->data.mode > INITIALIZATION) return 0;
    return (char *)&instance->data + range->place + size * (reference - range->first);
  }
  return 0;
}

$functions
static void start(Data *data) {
  memset(data, 0, sizeof(*data));
  reset(&data->own);
  data->mode = INSTANTIATED;
}

FMI3 const char *fmi3GetVersion(void) { return "3.0"; }

FMI3 Status fmi3SetDebugLogging(void *i, bool on, size_t count, const char *const categories[]) {
  (void)i, (void)on, (void)count, (void)categories;
  return OK;
}

FMI3 void *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool event_mode, bool early_return, const Reference required[], size_t count, void *environment,
    Log log, void *update) {
  Instance *instance;
  (void)name, (void)resources, (void)visible, (void)logging, (void)event_mode, (void)early_return;
  (void)required, (void)update;
  if (!token || strcmp(token, TOKEN) || count) {
    const char *said = count ? "no intermediate variables are required of it" : "another token";
    if (log) log(environment, ERROR, "logStatusError", said);
    return 0;
  }
  instance = (Instance *)malloc(sizeof(Instance));
  if (!instance) return 0;
  start(&instance->data);
  instance->log = log;
  instance->environment = environment;
  return instance;
}

FMI3 void fmi3FreeInstance(void *instance) { free(instance); }

FMI3 Status fmi3EnterInitializationMode(void *i, bool has_tolerance, double tolerance, double time,
                                        bool has_stop, double stop) {
  Instance *instance = (Instance *)i;
  (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
  if (instance->data.mode != INSTANTIATED) return failed(instance, "it was initialized before");
  if (!(fabs(time) < 1e15)) return failed(instance, "the start time is not finite");
  instance->data.time = time;
  instance->data.mode = INITIALIZATION;
  return OK;
}

FMI3 Status fmi3ExitInitializationMode(void *i) {
  Instance *instance = (Instance *)i;
  if (instance->data.mode != INITIALIZATION) return failed(instance, "it is not being initialized");
  instance->data.mode = STEPS;
  return begin(instance);
}

FMI3 Status fmi3Terminate(void *i) {
  ((Instance *)i)->data.mode = TERMINATED;
  return OK;
}

FMI3 Status fmi3Reset(void *i) {
  start(&((Instance *)i)->data);
  return OK;
}

FMI3 Status fmi3DoStep(void *i, double time, double length, bool no_way_back, bool *event,
                       bool *terminate, bool *early, double *last) {
  Instance *instance = (Instance *)i;
  Status status;
  (void)no_way_back;
  *event = *terminate = *early = false;
  *last = instance->data.time;
  if (instance->data.mode != STEPS) return failed(instance, "it is not initialized");
  if (!(fabs(time - instance->data.time) <= 1e-9 * fmax(1.0, fabs(time)))) {
    return failed(instance, "a step begins where the last one did not end");
  }
  if (!(length >= 0.0 && length < 1e15)) return failed(instance, "a step has no such length");
  status = step(instance, time + length);
  if (status == OK) instance->data.time = *last = time + length;
  return status;
}

#define ACCESS(Type, type, ranges)                                                               \
  FMI3 Status fmi3Get##Type(void *i, const Reference *references, size_t count, type *values,    \
                            size_t size) {                                                       \
    Instance *instance = (Instance *)i;                                                          \
    size_t k, total = sizeof(ranges) / sizeof(ranges[0]);                                        \
    if (size != count) return failed(instance, "all variables are scalars");                     \
    if (count && instance->data.mode == INITIALIZATION) refresh(instance);                       \
    for (k = 0; k < count; k++) {                                                                \
      void *place = find(instance, ranges, total, sizeof(type), references[k], false);           \
      if (!place) return failed(instance, "there is no such " #Type);                            \
      values[k] = *(type *)place;                                                                \
    }                                                                                            \
    return OK;                                                                                   \
  }                                                                                              \
  FMI3 Status fmi3Set##Type(void *i, const Reference *references, size_t count,                  \
                            const type *values, size_t size) {                                   \
    Instance *instance = (Instance *)i;                                                          \
    size_t k, total = sizeof(ranges) / sizeof(ranges[0]);                                        \
    if (size != count) return failed(instance, "all variables are scalars");                     \
    for (k = 0; k < count; k++) {                                                                \
      void *place = find(instance, ranges, total, sizeof(type), references[k], true);            \
      if (!place) return failed(instance, "there is no such " #Type " that may be set now");     \
      *(type *)place = values[k];                                                                \
    }                                                                                            \
    return OK;                                                                                   \
  }
ACCESS(Float64, double, floats)
ACCESS(Int32, int32_t, integers)

/* States of the FMU. */
FMI3 Status fmi3GetFMUState(void *i, void **state) {
  if (!*state) *state = malloc(sizeof(Data));
  if (!*state) return failed((Instance *)i, "there is no memory left");
  memcpy(*state, &((Instance *)i)->data, sizeof(Data));
  return OK;
}
FMI3 Status fmi3SetFMUState(void *i, void *state) {
  memcpy(&((Instance *)i)->data, state, sizeof(Data));
  return OK;
}
FMI3 Status fmi3FreeFMUState(void *i, void **state) {
  (void)i;
  free(*state);
  *state = 0;
  return OK;
}
FMI3 Status fmi3SerializedFMUStateSize(void *i, void *state, size_t *size) {
  (void)i, (void)state;
  *size = sizeof(Data);
  return OK;
}
FMI3 Status fmi3SerializeFMUState(void *i, void *state, uint8_t *bytes, size_t size) {
  if (size < sizeof(Data)) return failed((Instance *)i, "a state has more bytes");
  memcpy(bytes, state, sizeof(Data));
  return OK;
}
FMI3 Status fmi3DeserializeFMUState(void *i, const uint8_t *bytes, size_t size, void **state) {
  if (size != sizeof(Data)) return failed((Instance *)i, "a state has another number of bytes");
  if (!*state) *state = malloc(sizeof(Data));
  if (!*state) return failed((Instance *)i, "there is no memory left");
  memcpy(*state, bytes, sizeof(Data));
  return OK;
}

/* What FMI 3.0 has besides, and this FMU has not. */
#define NONE(Type, type)                                                                         \
  FMI3 Status fmi3Get##Type(void *i, const Reference *references, size_t count, type *values,    \
                            size_t size) {                                                       \
    (void)references, (void)values, (void)size;                                                  \
    return count ? failed((Instance *)i, "it has no " #Type) : OK;                               \
  }                                                                                              \
  FMI3 Status fmi3Set##Type(void *i, const Reference *references, size_t count,                  \
                            const type *values, size_t size) {                                   \
    (void)references, (void)values, (void)size;                                                  \
    return count ? failed((Instance *)i, "it has no " #Type) : OK;                               \
  }
NONE(Float32, float)
NONE(Int8, int8_t)
NONE(UInt8, uint8_t)
NONE(Int16, int16_t)
NONE(UInt16, uint16_t)
NONE(UInt32, uint32_t)
NONE(Int64, int64_t)
NONE(UInt64, uint64_t)
NONE(Boolean, bool)
NONE(String, char *)

#define ABSENT(name, ...) \
  FMI3 Status name(__VA_ARGS__) { return failed((Instance *)i, "it has no " #name); }
ABSENT(fmi3GetBinary, void *i, const Reference *a, size_t b, size_t *c, const uint8_t **d,
       size_t e)
ABSENT(fmi3SetBinary, void *i, const Reference *a, size_t b, const size_t *c, const uint8_t **d,
       size_t e)
ABSENT(fmi3GetClock, void *i, const Reference *a, size_t b, bool *c)
ABSENT(fmi3SetClock, void *i, const Reference *a, size_t b, const bool *c)
ABSENT(fmi3GetNumberOfVariableDependencies, void *i, Reference a, size_t *b)
ABSENT(fmi3GetVariableDependencies, void *i, Reference a, size_t *b, Reference *c, size_t *d,
       int *e, size_t f)
ABSENT(fmi3GetDirectionalDerivative, void *i, const Reference *a, size_t b, const Reference *c,
       size_t d, const double *e, size_t f, double *g, size_t h)
ABSENT(fmi3GetAdjointDerivative, void *i, const Reference *a, size_t b, const Reference *c,
       size_t d, const double *e, size_t f, double *g, size_t h)
ABSENT(fmi3EnterEventMode, void *i)
ABSENT(fmi3EnterStepMode, void *i)
ABSENT(fmi3EnterConfigurationMode, void *i)
ABSENT(fmi3ExitConfigurationMode, void *i)
ABSENT(fmi3GetIntervalDecimal, void *i, const Reference *a, size_t b, double *c, int *d)
ABSENT(fmi3GetIntervalFraction, void *i, const Reference *a, size_t b, uint64_t *c, uint64_t *d,
       int *e)
ABSENT(fmi3GetShiftDecimal, void *i, const Reference *a, size_t b, double *c)
ABSENT(fmi3GetShiftFraction, void *i, const Reference *a, size_t b, uint64_t *c, uint64_t *d)
ABSENT(fmi3SetIntervalDecimal, void *i, const Reference *a, size_t b, const double *c)
ABSENT(fmi3SetIntervalFraction, void *i, const Reference *a, size_t b, const uint64_t *c,
       const uint64_t *d)
ABSENT(fmi3SetShiftDecimal, void *i, const Reference *a, size_t b, const double *c)
ABSENT(fmi3SetShiftFraction, void *i, const Reference *a, size_t b, const uint64_t *c,
       const uint64_t *d)
ABSENT(fmi3EvaluateDiscreteStates, void *i)
ABSENT(fmi3UpdateDiscreteStates, void *i, bool *a, bool *b, bool *c, bool *d, bool *e, double *f)
ABSENT(fmi3GetOutputDerivatives, void *i, const Reference *a, size_t b, const int32_t *c,
       double *d, size_t e)
ABSENT(fmi3EnterContinuousTimeMode, void *i)
ABSENT(fmi3CompletedIntegratorStep, void *i, bool a, bool *b, bool *c)
ABSENT(fmi3SetTime, void *i, double a)
ABSENT(fmi3SetContinuousStates, void *i, const double *a, size_t b)
ABSENT(fmi3GetContinuousStateDerivatives, void *i, double *a, size_t b)
ABSENT(fmi3GetEventIndicators, void *i, double *a, size_t b)
ABSENT(fmi3GetContinuousStates, void *i, double *a, size_t b)
ABSENT(fmi3GetNominalsOfContinuousStates, void *i, double *a, size_t b)
ABSENT(fmi3GetNumberOfEventIndicators, void *i, size_t *a)
ABSENT(fmi3GetNumberOfContinuousStates, void *i, size_t *a)
ABSENT(fmi3ActivateModelPartition, void *i, Reference a, double b)
FMI3 void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources,
                                        bool visible, bool logging, void *environment, Log log) {
  if (log) log(environment, ERROR, "logStatusError", "it is for co-simulation only");
  return 0;
}
FMI3 void *fmi3InstantiateScheduledExecution(const char *name, const char *token,
                                             const char *resources, bool visible, bool logging,
                                             void *environment, Log log, void *update, void *lock,
                                             void *unlock) {
  if (log) log(environment, ERROR, "logStatusError", "it is for co-simulation only");
  return 0;
}
