"""Bodies of plain discs: the ellipses that two cameras measured go in, named discs come out.

Discs carry no code, so both cameras and the body's geometry identify them together.

- ``identify.py``: which disc each detection is, with no prior: pairs (``pairing.py``), triples with the body's
  distances, and the Bayes factor of each hypothesis (``hypothesis.py``).
- ``assign.py``: the same where the pose is known approximately.
- ``bias.py``: the perspective bias of an ellipse's centre, and what both cameras should see at a pose.
- ``symmetry.py``: the discs that may be taken for others, before a body is built (``armsight body check``).
"""
