"""What a measurement publishes while it runs: to the file run.mcap, and to readers on the network.

In: a :class:`~.datum.ShotDatum` a shot, a :class:`~.datum.JointsDatum` a batch of readings. Out, by ``sink.py``, each in a
thread of its own that never holds the loop: ``mcap_file.py`` (run.mcap), ``network.py`` (JSON lines over TCP and UDP),
``igtl.py`` (OpenIGTLink), ``websocket.py`` (Foxglove). ``foxglove.py`` makes the messages of the first and the last.

The names of what is published are those of docs/reference/data.md, in every form.
"""
