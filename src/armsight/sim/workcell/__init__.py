"""The workcell: an arm with motors, a board that runs the firmware, two cameras, a body on the tool, and time.

In: how far the arm is from its table, the cameras, a seed. Out: a Board and a Source, used as real ones are, and the truth.

- ``workcell``: :class:`~armsight.sim.workcell.workcell.Workcell`, which puts the parts together and owns the time;
- ``arm``: imperfections of the true arm; ``motors``: its solids and motors; ``plant``: its dynamics, potentiometers and
  converter; ``board``: the board's configuration;
- ``cameras``: when and where the cameras look, as a source of shots; ``images``: the images of one camera;
- ``raycast``: what stands still around the arm; ``body``: the body on the tool.
"""
