"""The viewer of trained models: reading trials (``trials``), drawing them (``picture``), and serving (``server``)."""

ADDRESS = "a trial's folder, or EXPERIMENT:SCENE:DENSIFY[:SEED] such as demo:courtyard:volumetric:0"
