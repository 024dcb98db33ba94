"""Fit a virtual camera to a recording of a real one, and check a recipe as a laboratory does.

command     the command line
recording   what is read of a recording: events and frames of some pixels
increments  changes of brightness beside events, still stretches, intervals
interval    estimates with intervals by a bootstrap over blocks
regression  thresholds, low-pass and dark floor from the changes
estimators  noise, mismatch, refractory period and defects
statistics  the recording's frames through the product's kernel; statistics of both, and their distance
fit         the whole fit, fit(); which effects stay
report      the recipe file, and the report in words and as a picture
lab         a simulated camera on a test bench
"""
