typedef struct {
  ${prefix}_controller controller;
  ${prefix}_controller_inputs in;
  ${prefix}_controller_outputs out;
  double age, origin;
  long long tick; /* that comes next, from origin on */
} Own;
