typedef struct {
  ${prefix}_plant plant;
  double start[${guard}_PLANT_STATES + 1];
} Own;
