"""What a reconstruction is turned into: result folder, renders, exports, report."""
