"""Saturated samples: the segment objective, gap shapes and solvers."""
