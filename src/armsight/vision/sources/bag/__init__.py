"""Recordings of other programs: ROS 1 bags, ROS 2 bags (sqlite3, MCAP) and Foxglove's MCAP.

In: a file, or the folder of a ROS 2 bag. Out: shots (``images.py``), the rig that its camera_info describe
(``camera_info.py``), tag corners that were recorded instead of images (``tags.py``), joints and poses of the flange
(``states.py``). ``reader.py`` reads messages of every container, ``pairing.py`` pairs two topics by time.

What a bag holds and cannot be used is said, in ``notes``, and the rest is read.
"""

from __future__ import annotations

from armsight.vision.sources.bag.images import BagSource, open_bag_source
from armsight.vision.sources.bag.reader import Bag, BagMessage, Topic

__all__ = ["Bag", "BagMessage", "BagSource", "Topic", "open_bag_source"]
