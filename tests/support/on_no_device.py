"""CUDA without a GPU: threads one after the other, and the part of CuPy that rollouts use."""

import ctypes
import time
from types import SimpleNamespace

import numpy as np

from drake_dae.trace.compiled import library

SHIM = """
#include <math.h>
#include <string.h>
#define __CUDACC__ 1
#define __device__
#define __noinline__ __attribute__((noinline))
#define __global__ static
static struct { unsigned x; } blockIdx, blockDim, threadIdx;
static unsigned long long atomicAdd(unsigned long long *to, unsigned long long count) {
  *to += count;
  return *to - count;
}
"""
LAUNCH = """
__attribute__((visibility("default")))
void launch(const Batch *b, unsigned blocks, unsigned threads) {
  blockDim.x = threads;
  for (blockIdx.x = 0; blockIdx.x < blocks; blockIdx.x++) {
    for (threadIdx.x = 0; threadIdx.x < threads; threadIdx.x++) run_on_device(b);
  }
}
"""


class Array(np.ndarray):
    """An array of the processor that has an address as one of a device has."""

    @property
    def data(self):
        return SimpleNamespace(ptr=self.ctypes.data)

    def get(self):
        return np.array(self)


class RawModule:
    """The source as machine code of the processor."""

    def __init__(self, code, options):
        path = library(SHIM + code + LAUNCH, 1000, True, True)
        assert path is not None
        self._code = ctypes.CDLL(str(path))

    def get_function(self, name):
        assert name == "run_on_device"
        return lambda blocks, threads, given: self._code.launch(
            ctypes.c_void_p(given[0].ctypes.data), blocks[0], threads[0]
        )


class Event:
    """A moment, since all is done at once."""

    def record(self):
        self.time = time.perf_counter()

    def synchronize(self):
        pass


def fake_cupy(devices=1):
    """CuPy with some devices, each of which is this processor."""
    runtime = SimpleNamespace(getDeviceCount=lambda: devices)
    return SimpleNamespace(
        cuda=SimpleNamespace(
            runtime=runtime,
            Event=Event,
            get_elapsed_time=lambda begin, end: 1e3 * (end.time - begin.time),
        ),
        asarray=lambda array: np.array(array).view(Array),
        RawModule=RawModule,
    )
