from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from make_images import write_image
from numpy.typing import NDArray
from PIL import Image as Picture
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import Camera, Pose, View
from aeromatch_cli.errors import ItemError
from aeromatch_cli.geometry.cameras import undistort
from aeromatch_cli.geometry.rotations import compose_nadir  # noqa: F401
