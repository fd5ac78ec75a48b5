"""Compiled loops: flat arrays and numbers in, arrays out, no state.

Everything that is too slow in numpy lives in this package and nowhere else. Kernels are plain
functions of arrays; :func:`gvpipe.core.kernels.jit.kernel` compiles them on first use.
"""
