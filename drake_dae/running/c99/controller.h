/* $title: the whole controller as one step.

   Written by drake_dae $version with CasADi $casadi; the terms are in LICENSE.txt. Nothing but the C
   library and libm is needed. No function allocates or calls the system, and a step takes the same
   time in every call. All that is kept stands in one struct, of which there may be many.

       ${prefix}_controller controller;
       ${prefix}_controller_inputs in;
       ${prefix}_controller_outputs out;
       ${prefix}_controller_init(&controller);
       each $period s:  fill in;  ${prefix}_controller_step(&controller, &in, &out);  send out.control;

   Compile it as the Makefile does. */

#ifndef ${guard}_CONTROLLER_H
#define ${guard}_CONTROLLER_H

#ifdef __cplusplus
extern "C" {
#endif

/* The time between steps in s, and the time at the first one, from which references count. */
#define ${guard}_CONTROLLER_PERIOD $period
#define ${guard}_CONTROLLER_START $start

/* What the controller does.

   While inputs are good it is RUNNING. An input is bad that is not finite or beyond 1e30, or was
   measured more than max_age before; a clock that runs backwards, a step that was left out, and
   inputs for which the law has no value count as bad, too. Then it is HOLDING: the last good inputs
   take the place of the bad ones, time goes on, and steps that were left out are made up for; where
   the law has no value, the last control stays. After more than `patience` bad steps in a row it is
   STOPPED, for good: the control goes from its last value to stop_control, linearly within
   stop_time, and nothing else moves. ${prefix}_controller_init begins anew. Before the first good
   inputs it is WAITING, with stop_control.

   A stop_control of zeros is right where the robot compensates gravity itself or has brakes, which
   belong on at STOPPED; else set it to what holds the robot. */
enum {
  ${guard}_RUNNING = 0,
  ${guard}_HOLDING = 1,
  ${guard}_STOPPED = 2,
  ${guard}_WAITING = 3
};

/* What was wrong in a step, or what led to a stop. */
enum {
  ${guard}_NO_FAULT = 0,
  ${guard}_FAULT_NUMBER = 1, /* an input is not finite, or beyond 1e30 */
  ${guard}_FAULT_STALE = 2,  /* the inputs are too old */
  ${guard}_FAULT_LATE = 3,   /* steps were left out before this one */
  ${guard}_FAULT_CLOCK = 4,  /* the clock runs backwards, or is no number */
  ${guard}_FAULT_VALUE = 5   /* the law has no value for the inputs, as where B(x) is singular */
};

enum {
  ${guard}_CONTROLLER_PARAMETERS = $num_parameters,
  ${guard}_CONTROLLER_INPUTS = $num_inputs,
  ${guard}_CONTROLLER_OUTPUTS = $num_outputs,
  ${guard}_CONTROLLER_CONTROLS = $num_controls,
  ${guard}_CONTROLLER_HELD = $num_held
};

typedef struct {
  double time;        /* now, in s, by any clock; the first good step sets its zero */
  double measured_at; /* when what follows was measured, by the same clock */
$inputs} ${prefix}_controller_inputs;

typedef struct {
$outputs  int status;    /* RUNNING, HOLDING, STOPPED or WAITING */
  int fault;     /* what was wrong */
  int bad_steps; /* how many steps in a row were bad; 0 while all is well */
} ${prefix}_controller_outputs;

typedef struct {
  /* May be changed between steps: */
  double parameters[${guard}_CONTROLLER_PARAMETERS + ${guard}_CONTROLLER_INPUTS];
    /* the model and the gains; then the last good inputs */
  double stop_control[${guard}_CONTROLLER_CONTROLS];
  double stop_time; /* in s */
  double max_age;   /* in s */
  int patience;     /* steps */
  /* Its own: */
  double held[${guard}_CONTROLLER_HELD + 1];
  double row[${guard}_CONTROLLER_OUTPUTS], zero, stopping;
  long long tick;
  int status, fault, bad_steps;
} ${prefix}_controller;

/* Names and units of the parameters; their ends are null. */
extern const char *const ${prefix}_controller_parameter_names[];
extern const char *const ${prefix}_controller_parameter_units[];

/* Default parameters, no memory, and: stop_control 0, stop_time 0.1 s, max_age 1.5 periods,
   patience 10 steps. */
void ${prefix}_controller_init(${prefix}_controller *controller);

/* One step. It reads time, so that it may be called late, or more often than each period: within one
   period it returns the outputs again. Returns the status. */
int ${prefix}_controller_step(${prefix}_controller *controller,
                              const ${prefix}_controller_inputs *inputs,
                              ${prefix}_controller_outputs *outputs);

#ifdef __cplusplus
}
#endif

#endif
