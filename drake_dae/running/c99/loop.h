/* $title: a loop over time, in fixed steps.

   Written by drake_dae $version with CasADi $casadi; the terms are in LICENSE.txt. Nothing but the C
   library and libm is needed, and no function allocates or calls the system. All that is kept stands
   in one struct, of which there may be many.

       ${prefix}_loop loop;
       ${prefix}_loop_init(&loop);
       ${prefix}_loop_advance(&loop, 0.01);   to t = 0.01 s; loop.outputs are those of then

   Outputs come after the updates of their time; those of a state on N* (4) before it is projected. */

#ifndef ${guard}_LOOP_H
#define ${guard}_LOOP_H

#ifdef __cplusplus
extern "C" {
#endif

enum {
  ${guard}_LOOP_STATES = $num_states,
  ${guard}_LOOP_PARAMETERS = $num_parameters,
  ${guard}_LOOP_OUTPUTS = $num_outputs,
  ${guard}_LOOP_HELD = $num_held,
  ${guard}_LOOP_RATES = $num_rates
};

/* What functions return. Unless it is OK, time is that of the last good step. */
enum {
  ${guard}_OK = 0,
  ${guard}_NO_VALUE = 1,    /* A function has no value: not finite, or singular. */
  ${guard}_OFF_MANIFOLD = 2 /* There is no consistent state near. */
};

typedef struct {
$outputs} ${prefix}_loop_outputs;

typedef struct {
  /* May be changed between steps: */
  double parameters[${guard}_LOOP_PARAMETERS + 1];
  double state[${guard}_LOOP_STATES + 1];
  double longest; /* step, in s; at first $longest */
  /* To be read: */
  double time; /* in s */
  ${prefix}_loop_outputs outputs;
  /* Its own: */
  double held[${guard}_LOOP_HELD + 1];
  long long next[${guard}_LOOP_RATES + 1];
  int has_begun;
} ${prefix}_loop;

/* Names and units of the parameters; their ends are null. */
extern const char *const ${prefix}_loop_parameter_names[];
extern const char *const ${prefix}_loop_parameter_units[];

/* Default parameters and the start, at t = $start s. */
void ${prefix}_loop_init(${prefix}_loop *loop);

/* Steps of at most `longest` by $scheme up to a time; outputs are those of then. */
int ${prefix}_loop_advance(${prefix}_loop *loop, double time);

#ifdef __cplusplus
}
#endif

#endif
