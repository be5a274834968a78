"""What users may leave out: calibration from boards and heads, refinement by a video, further importers, a live view.

Nothing else of the package but its commands, and `mifit.fit` for captures without calibration, imports it.
"""
