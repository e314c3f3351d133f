/* $title: the $what over time, in fixed steps.

   Written by drake_dae $version with CasADi $casadi; the terms are in LICENSE.txt. Nothing but the C
   library and libm is needed, and no function allocates or calls the system. All that is kept stands
   in one struct, of which there may be many.

       ${prefix}_$kind $kind;
       ${prefix}_${kind}_init(&$kind);
       ${prefix}_${kind}_advance(&$kind, 0.01);   to t = 0.01 s; $kind.row has the outputs then

   At the start of each step the state is brought onto N* (4), as in Drake; outputs are those before
   that, as a record has them. Inputs are held in between. */

#ifndef ${guard}_${KIND}_H
#define ${guard}_${KIND}_H

#ifdef __cplusplus
extern "C" {
#endif

enum {
  ${guard}_${KIND}_STATES = $num_states,
  ${guard}_${KIND}_PARAMETERS = $num_parameters,
  ${guard}_${KIND}_INPUTS = $num_inputs,
  ${guard}_${KIND}_OUTPUTS = $num_outputs
};

/* What functions return. Unless it is OK, time is that of the last good step. */
enum {
  ${guard}_${KIND}_OK = 0,
  ${guard}_${KIND}_NO_VALUE = 1,    /* A function has no value: not finite, or singular. */
  ${guard}_${KIND}_OFF_MANIFOLD = 2 /* There is no consistent state near. */
};

typedef struct {
  /* May be changed between steps: */
  double parameters[${guard}_${KIND}_PARAMETERS + ${guard}_${KIND}_INPUTS + 1]; /* then the inputs */
  double state[$num_state];
  double longest; /* step, in s; at first $longest */
  /* To be read: */
  double time; /* in s */
  double row[${guard}_${KIND}_OUTPUTS + 1];
  /* Its own: */
  double held[$num_held], given[$num_given], given_time;
  long long next[$num_rates];
  int has_begun;
} ${prefix}_$kind;

/* Names and units of parameters, states, inputs and outputs; their ends are null. */
extern const char *const ${prefix}_${kind}_names_of_parameters[];
extern const char *const ${prefix}_${kind}_units_of_parameters[];
extern const char *const ${prefix}_${kind}_names_of_states[];
extern const char *const ${prefix}_${kind}_units_of_states[];
extern const char *const ${prefix}_${kind}_names_of_inputs[];
extern const char *const ${prefix}_${kind}_units_of_inputs[];
extern const char *const ${prefix}_${kind}_names_of_outputs[];
extern const char *const ${prefix}_${kind}_units_of_outputs[];

/* Default parameters and the start, at t = $start s. */
void ${prefix}_${kind}_init(${prefix}_$kind *$kind);

/* Steps of at most `longest` by $scheme up to a time; then outputs are those of that time. */
int ${prefix}_${kind}_advance(${prefix}_$kind *$kind, double time);

/* Computes the outputs again, as after a change of the state or of the inputs. */
int ${prefix}_${kind}_show(${prefix}_$kind *$kind);

#ifdef __cplusplus
}
#endif

#endif
