"""The names of files and folders: in the runs folder, in the store and in a trial's. Spelled here and nowhere else.

A trial lies in ``<runs>/<experiment>/<scene>/<init>-<densify>/<hash8>-seed<k>/``.
"""

# in the runs folder, beside the experiments
STORE = "store"  # results of stages by content
ARTIFACTS, DATABASE = "mlartifacts", "mlflow.db"  # MLflow's mirror
TENSORBOARD, WANDB = "tensorboard", "wandb"  # the mirrors of others
IN_RUNS = (STORE, ARTIFACTS, DATABASE, TENSORBOARD, WANDB)
JOBS = ".jobs"  # what the processes of launch=local and Slurm's jobs print, a folder for each experiment

# in the store
MANIFEST = "manifest.json"  # in every result of a stage: what made it
VIEWS = "views"  # beside the stages: photographs undistorted and at their final size

# in the result of a stage
TRAINING = "training.json"  # what a training took and gave
METRICS = "metrics.json"  # of an evaluation

# in an experiment's folder
PLAN = "plan.json"  # the trials that were asked for
DECLARED = "declared.jsonl"  # the metrics that verdicts were declared to be about, and when
TUNING = "tuning.json"  # of a search: what was searched for an arm of a sweep, and what was found
SEED = "-seed"  # in the name of a trial's folder, between hash and seed
TRIAL_GLOB = f"*/*/*{SEED}*"  # the trials that are there

# in a trial's folder
CONFIG = "config.yaml"
RESULTS = "results.json"  # written last: a trial that has it is complete
FAILED = "failed.json"  # why it failed
LOG = "log.txt"
LOCK = ".lock"
SUBMITTED = ".submitted.json"  # the Slurm job that was given the trial
BUILDING = "building.json"  # the stage that an unfinished trial is at, and where
INIT_REPORT = "init_report.json"
PER_VIEW = "per_view.csv"
FROM_PIXELS = "from_pixels.json"  # measures of pictures, in a trial that an archive brought without its pictures
CURVES = "metrics.jsonl"  # of the training
EVENTS = "events.jsonl"  # what every refinement did
HISTOGRAMS = "volume_histograms.jsonl"
POINT_CLOUD = "point_cloud.ply"
TRAINER_LOG = "trainer.log"  # the output of another program that trained
LINEAGE = "lineage.npz"  # for each Gaussian its parent, and the rule that made it
RENDERS, GROUND_TRUTH = "renders", "ground_truth"  # a file for each test view
MASKS = "masks"  # of the test views that ignore some pixels: black there
FIGURES = "figures"  # pictures for the report
INITIAL_CLOUD = "initial_cloud.png"  # one of them
ELLIPSOIDS = "ellipsoids.png"  # another
