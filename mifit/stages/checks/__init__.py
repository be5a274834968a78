"""What is wrong with a capture, before it is fitted and after."""
