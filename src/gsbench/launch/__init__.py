"""Planning trials and running them: in this process, in others of this machine, or in Slurm."""
