# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What finds a board in images, and why an image is not used."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from calib_ros.sampling.sample import View


class Flaw(NamedTuple):
    """Why an image is not used: its kind, and what was found in it."""

    cause: str
    reason: str


class BoardFinder(Protocol):
    """A board detector for images."""

    def learn(self, info: Any) -> None:
        """Take a CameraInfo."""

    def look(self, message: Any) -> View | Flaw:
        """Return the corners in an Image or CompressedImage."""
