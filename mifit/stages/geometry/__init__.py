"""The parts of stage 1: parameters, projection, landmark and photometric terms, and the fits built from them."""
