/* The exports of ${name}.wasm: functions of each part, on pointers that `create` returns. */

#include <stddef.h>

$includes
#define SHOWN(name) __attribute__((export_name(name)))

extern unsigned char __heap_base;

/* Allocates memory, which is never released; returns 0 if there is not enough. */
static void *take(size_t size) {
  static size_t used;
  size_t first = (size_t)&__heap_base + used, page = 65536;
  size_t end, there = __builtin_wasm_memory_size(0) * page;
  first = (first + 15) / 16 * 16;
  end = first + size;
  if (end > there && __builtin_wasm_memory_grow(0, (end - there + page - 1) / page) == (size_t)-1) {
    return 0;
  }
  used = end - (size_t)&__heap_base;
  return (void *)first;
}

$parts
