"""What frames of a video say, absorbed into sums of a fixed size per texel."""
