"""SSIM by scikit-image, with which gsbench's is compared."""

import numpy as np
from skimage.metrics import structural_similarity


def ssim_map(image, truth, beyond=0):
    """SSIM of each pixel [H, W, 3] for images in [0, 1], in windows that lie within the image.

    With ``beyond`` there are so many pixels of zeros around the images.
    """
    border = ((beyond, beyond), (beyond, beyond), (0, 0))
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    pair = (np.pad(picture, border) for picture in (image, truth))
    _, full = structural_similarity(*pair, channel_axis=-1, data_range=1, full=True, **settings)
    return full[5:-5, 5:-5]
