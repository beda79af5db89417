"""The viewer of trained models: reading and drawing (``trials``), serving (``server``)."""

ADDRESS = "a trial's folder, or EXPERIMENT:SCENE:ARM[:SEED] such as demo:courtyard:volumetric:0"
