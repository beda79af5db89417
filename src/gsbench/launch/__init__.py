"""Planning trials and running them: in this process, in other processes of this machine, or in
Slurm."""
