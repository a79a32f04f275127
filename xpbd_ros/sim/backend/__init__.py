"""
Code generation: the ``jit`` decorator with its disk cache, linking of kernels into their callers,
SIMD vectors and records, threads, and the floating-point mode.

Kernels elsewhere are written in terms of these. It imports NumPy, Numba and LLVM, and nothing of
the simulation.
"""
