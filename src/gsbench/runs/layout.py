"""The names of all files and folders in the runs folder, the store and trials' folders.

A trial's folder is ``<runs>/<experiment>/<scene>/<init>-<densify>/<hash8>-seed<k>/``.
"""

# in the runs folder, beside the experiments
STORE = "store"  # results of stages by key
ARTIFACTS, DATABASE = "mlartifacts", "mlflow.db"  # MLflow's files
TENSORBOARD, WANDB = "tensorboard", "wandb"  # other trackers' files
IN_RUNS = (STORE, ARTIFACTS, DATABASE, TENSORBOARD, WANDB)
JOBS = ".jobs"  # output of the jobs of launch=local and launch=slurm, with a folder per experiment

# in the store
MANIFEST = "manifest.json"  # in every result: what made it

# in the result of a stage
TRAINING = "training.json"  # counts, time and memory of a training
METRICS = "metrics.json"  # of an evaluation

# in an experiment's folder
COMMANDS = "commands.jsonl"  # all commands, with their trials and questions
# of gsbench 0.1, no longer read: declared questions, and a ledger of ideas
DECLARED, LEDGER = ASKED_EARLIER = "declared.jsonl", "ledger.jsonl"
TUNING = "tuning.json"  # of a search: its ranges and points
SEED = "-seed"  # between hash and seed in the name of a trial's folder
TRIAL_GLOB = f"*/*/*{SEED}*"  # all trials' folders

# in a trial's folder
CONFIG = "config.yaml"
RESULTS = "results.json"  # written last: a trial that has it is complete
FAILED = "failed.json"  # the error of the last run
LOG = "log.txt"
LOCK = ".lock"
SUBMITTED = ".submitted.json"  # the trial's Slurm job
ASKED = "asked.json"  # the questions that covered the trial when its training began
BUILDING = "building.json"  # the present stage of an unfinished trial, and its folder
INIT_REPORT = "init_report.json"
PER_VIEW = "per_view.csv"
# measures of pictures, in a trial from an archive without pictures
FROM_PIXELS = "from_pixels.json"
REGIONS = "regions.json"
CURVES = "metrics.jsonl"  # of the training
EVENTS = "events.jsonl"  # counts of every refinement by cause
HISTOGRAMS = "volume_histograms.jsonl"
POINT_CLOUD = "point_cloud.ply"
TRAINER_LOG = "trainer.log"  # the output of another program that trained
LINEAGE = "lineage.npz"  # each Gaussian's parent, and the rule that made it
RENDERS, GROUND_TRUTH = "renders", "ground_truth"  # a picture per test view
MASKS = "masks"  # masks of test views: ignored pixels are black
