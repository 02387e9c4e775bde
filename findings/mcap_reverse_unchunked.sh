#!/bin/sh
# mcap 1.6.0: iter_messages(reverse=True) of a file without chunks goes forwards.
#
# The usual way to the last message, next(reader.iter_messages(reverse=True)), gives the first one, and the whole comes from
# the earliest to the latest, where the file was written with use_chunking=False, as loggers on small computers do to lose
# nothing in a crash. Nothing is said. The same messages in chunks come backwards, and so do those of the file without
# chunks through NonSeekingReader, which make_reader returns for a stream that cannot seek.
#
# Seen, log times of three messages asked for backwards: in chunks 3 2 1; without chunks 1 2 3, through a stream 3 2 1.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mcap==1.6.0
"$folder/venv/bin/python" - <<'PYTHON'
import io

from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer


def written(chunks):
    out = io.BytesIO()
    writer = Writer(out, use_chunking=chunks)
    writer.start()
    channel = writer.register_channel("/joints", "json", writer.register_schema("joints", "jsonschema", b"{}"))
    for time in (1, 2, 3):
        writer.add_message(channel, log_time=time, publish_time=time, data=b"{}")
    writer.finish()
    return io.BytesIO(out.getvalue())


def backwards(reader):
    return [message.log_time for _, _, message in reader.iter_messages(reverse=True)]


found = backwards(make_reader(written(True))), backwards(make_reader(written(False))), backwards(NonSeekingReader(written(False)))
print("in chunks {}; without chunks {}, through a stream {}".format(*found))
assert found == ([3, 2, 1], [1, 2, 3], [3, 2, 1])
PYTHON
