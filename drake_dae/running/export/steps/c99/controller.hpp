/* $title: the controller of ${name}_controller.h as a class of C++. */

#ifndef ${guard}_CONTROLLER_HPP
#define ${guard}_CONTROLLER_HPP

#include "${name}_controller.h"

namespace $prefix {

using Inputs = ${prefix}_controller_inputs;
using Outputs = ${prefix}_controller_outputs;

/* Settings and memory are members of the struct: `controller.patience = 5`. */
class Controller : public ${prefix}_controller {
 public:
  static constexpr double period = ${guard}_CONTROLLER_PERIOD;

  Controller() { reset(); }

  /* Begins anew, with default settings. */
  void reset() { ${prefix}_controller_init(this); }

  /* One step; see the header of C. The reference is good until the next one. */
  const Outputs &step(const Inputs &inputs) {
    ${prefix}_controller_step(this, &inputs, &outputs_);
    return outputs_;
  }

 private:
  Outputs outputs_{};
};

}  // namespace $prefix

#endif
