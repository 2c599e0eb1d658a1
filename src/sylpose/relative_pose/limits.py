"""Numerical limits that the iterative solvers of this package share."""

from __future__ import annotations

import numpy as np

# Half of the digits of a number (derived). A share of it that is added to the diagonal of normal equations keeps them
# solvable and changes a step by less than the linearization does. It is also the share of a prior that determines what
# the data leave open, or that an estimated variance keeps, and the tolerance of iterations that cost little; its inverse is
# the weight of an equation that is to hold exactly.
HALF_DIGITS = float(np.sqrt(np.finfo(float).eps))
# Maximum number of matches, regularly selected, where more would only cost time: in rankings of hypotheses and comparisons
# of neighbors (choice).
MAX_SAMPLES = 256
# A fit has converged if the predicted decrease of its cost, half the square of the step in standard deviations, is below the
# first value, a thirtieth of a standard deviation; a search for starts, or across a valley, below the second (choice).
CONVERGED_DECREASE, ROUGHLY_CONVERGED_DECREASE = 5e-4, 1e-2
# A fit whose last step was one standard deviation long has not converged, and its planar part needs no more: half of the
# square (derived).
DECREASE_OF_ONE_SD = 0.5
# Maximum number of rounds of a solver, and of one that finds a start for another, or a camera's own motion (choice).
MAX_ROUNDS, MAX_STEPS = 40, 20
# Largest rotation of a step, radians: the range in which the derivatives are valid (choice).
MAX_ROTATION_STEP = 0.3
# What exceeds so many standard deviations is no chance (choice): an error, or the number of matches that moved (at 3, 5 of
# 30 static scenes of 20 matches are taken for moving ones, at 5 two). As the cutoff of Tukey's bisquare it is 94 %
# efficient with Gaussian noise in two directions, whose squared length is chi-squared with two degrees of freedom. Hidden
# minima are searched as far from a motion.
CUTOFF = 5.0
# Least share of a camera's matches that agree for the camera to be used: junk alone reaches about a tenth (choice).
MIN_SHARE = 1.0 / 3.0
# Most of the matches agree if those that do not are too few for another motion (derived).
MOST = 1.0 - MIN_SHARE
# Probability of a mismatch (choice).
MISMATCH_PROBABILITY = 0.05
# Upper bound of the noise relative to that of the seeds: otherwise noise would explain two motions, or none (choice).
MAX_SIGMA_GROWTH = 2.0
# Smaller errors of images, pixels, are no evidence: rounding, lenses, perspective (choice).
MIN_ERROR_PX = 0.15
# Lower bound of the noise, pixels: exact matches, and those of frozen images, have none (choice).
SIGMA_FLOOR_PX = 0.02
