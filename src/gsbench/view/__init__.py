"""Looking at trained models in the browser: what to draw (``trials``), how (``picture``), and where (``server``)."""

ADDRESS = "a trial's folder, or EXPERIMENT:SCENE:DENSIFY[:SEED] such as demo:courtyard:volumetric:0"
