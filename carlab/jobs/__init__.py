"""Jobs: child processes with input and output files, on this machine or on a Ray cluster."""
