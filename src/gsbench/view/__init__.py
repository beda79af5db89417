"""The viewer of trained models: reading and drawing trials (``trials``), and serving them
(``server``)."""

ADDRESS = "a trial's folder, or EXPERIMENT:SCENE:DENSIFY[:SEED] such as demo:courtyard:volumetric:0"
