/* $title: tracking law, plant and projection, as plain C99.

   Written by drake_dae $version with CasADi $casadi; the terms are in LICENSE.txt. Nothing but the C
   library and libm is needed. No function allocates, keeps anything between calls, or calls the
   system, and each takes the same time in every call, ${prefix}_project except for its iterations.

   Compile it as the Makefile does. */

#ifndef ${guard}_H
#define ${guard}_H

#ifdef __cplusplus
extern "C" {
#endif

/* What functions return. Unless it is ${guard}_OK, results are of no use. */
enum {
  ${guard}_OK = 0,
  ${guard}_NOT_FINITE = 1,   /* An input is not finite or beyond 1e30, or it leaves a domain. */
  ${guard}_SINGULAR = 2,     /* A(x) or B(x) of Assumptions (2), (5) is singular. */
  ${guard}_NOT_CONVERGED = 3 /* No consistent state was found near the given one. */
};

/* The vectors, their entries and units. Each has its size, names and units in arrays that end with
   a null pointer; parameters have their defaults too. */
$vectors
/* The law (28): u = B(x)^-1 (-a(x) + ubar(x, R)). */
int ${prefix}_law($law);

/* The plant (1)-(3) on N*: x' = f + g v + h u, v = alpha + beta u, z = l + m v. */
int ${prefix}_plant($plant);

/* What is zero on N* (4): the constraint outputs and their derivatives. */
int ${prefix}_residual($residual);

/* The consistent state (4) next to a given one, to round-off, by damped Newton steps of least norm:
   state is replaced, but only if the result is ${guard}_OK. At most 200 iterations; after a step of
   an integrator one or two. */
int ${prefix}_project(double *state, const double *parameters);

/* The loop as a whole, if all of its blocks could be traced: the derivative of its states, its
   outputs, and what blocks hold from a sample on. */
$whole
#ifdef __cplusplus
}
#endif

#endif
