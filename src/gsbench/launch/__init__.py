"""Trials as work: planning, and running them here, in processes or in Slurm."""
