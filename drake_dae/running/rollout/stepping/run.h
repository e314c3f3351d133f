/* A run, which can be stopped at any step and go on. */
typedef struct {
  double time, step;       /* the state is accepted at this time; what step to try next, 0 if none */
  double start, mark;      /* of the run, and after its last thousand steps */
  double before;           /* the mark before */
  double from;             /* where a row of fixed steps began, to its end */
  double next;             /* where the last step should have led */
  double trial;            /* of the earliest trial that failed since the accepted state */
  long long row, event;    /* which come next */
  long long steps;         /* that were accepted */
  long long number, index; /* of fixed steps in this row, and which comes next */
  long long failures;      /* of trials since the accepted state */
  long long pending;       /* what is to come before the next step, as below */
} Run;

/* Unrestricted updates, the projection, discrete updates: in this order. */
enum { UNRESTRICTED = 1, PROJECTION = 2, DISCRETE = 4, ALL = 7 };
