"""gsbench as a Hydra app: Hydra's steps, grids of a sweep, search."""
