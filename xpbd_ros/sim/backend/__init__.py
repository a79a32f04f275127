"""
Code generation: the ``jit`` decorator with its disk cache, linking of kernels into their callers,
SIMD vectors and records, threads, the floating-point mode; PTX, a card's memory and driver.

Kernels elsewhere are written in terms of these. It imports NumPy, Numba and LLVM, and nothing of
the simulation.
"""
