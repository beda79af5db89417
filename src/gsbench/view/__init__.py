"""Looking at trained models in the browser: what to draw (``trials``), how (``picture``), and where (``server``)."""
