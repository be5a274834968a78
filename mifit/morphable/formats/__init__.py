"""Model files: one module per format; ``recognise`` tells them apart."""
