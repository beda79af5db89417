"""Structure from motion with COLMAP, one station a file.

    pairs, features, matches, geometry, mapping, alignment

Each station imports only earlier ones. They exchange results in COLMAP's database (``database``),
then as a model (``models``). ``init.sfm`` and ``init.dim`` differ in features and matches;
``init.placed`` makes only new points, so it skips these stations.
"""
