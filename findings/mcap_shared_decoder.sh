#!/bin/sh
# mcap-ros2-support 0.6.0, mcap-protobuf-support 0.6.0: a DecoderFactory used for two files decodes the second by the first's types.
#
# make_reader(file, decoder_factories=[DecoderFactory()]) is the documented way to decode an MCAP, and nothing says that a factory
# is for one file. It keeps its decoders by the schema's id, which counts from 1 in every file. A program that makes the
# factory once and reads many recordings decodes message types by the number they had in the first: where a message was given
# other fields between two recordings, or topics came in another order, numbers arrive under other names. CDR has no tags: any
# message of the same length decodes. A Protobuf field keeps its number, and its name is the first file's. The channel
# and the schema that come with the message are the right ones.
#
# Two recordings of one message: float64 q1_deg, q2_deg, and, after its author changed the order, q2_deg, q1_deg;
# each says q1_deg 10, q2_deg 20. Then a message of two Points, and a Twist in another file.
#
# Seen, q1_deg and q2_deg of the second file: ROS 2 and Protobuf 20 10; with a factory of its own 10 20; the Twist 1 2 3, 4 5 6:
# start 1 2 3, end 4 5 6, beside the schema's name geometry_msgs/msg/Twist.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mcap==1.6.0 mcap-ros2-support==0.6.0 mcap-protobuf-support==0.6.0 protobuf==6.33.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import io
import struct

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
from mcap_ros2.decoder import DecoderFactory as Ros2Factory

XYZ = "float64 x\nfloat64 y\nfloat64 z\n"
TWIST = "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n" + "=" * 80 + "\nMSG: geometry_msgs/Vector3\n" + XYZ
SPAN = "geometry_msgs/Point start\ngeometry_msgs/Point end\n" + "=" * 80 + "\nMSG: geometry_msgs/Point\n" + XYZ


def recording(name, kind, schema, encoding, data):
    """Return an MCAP with one message."""
    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    channel = writer.register_channel("/topic", encoding, writer.register_schema(name, kind, schema))
    writer.add_message(channel, 0, data, 0)
    writer.finish()
    return file


def ros2(name, text, *numbers):
    data = b"\x00\x01\x00\x00" + struct.pack(f"<{len(numbers)}d", *numbers)
    return recording(name, "ros2msg", text.encode(), "cdr", data)


def protobuf(names, **values):
    described = FileDescriptorProto(name="joints.proto", package="lab", syntax="proto3")
    message = described.message_type.add(name="Joints")
    for number, name in enumerate(names, 1):
        message.field.add(
            name=name, number=number, type=FieldDescriptorProto.TYPE_DOUBLE, label=FieldDescriptorProto.LABEL_OPTIONAL
        )
    pool = DescriptorPool()
    pool.Add(described)
    made = GetMessageClass(pool.FindMessageTypeByName("lab.Joints"))(**values)
    schema = FileDescriptorSet(file=[described]).SerializeToString()
    return recording("lab.Joints", "protobuf", schema, "protobuf", made.SerializeToString())


def decoded(file, factory):
    file.seek(0)
    ((schema, _, _, message),) = make_reader(file, decoder_factories=[factory]).iter_decoded_messages()
    return schema.name, message


q = {"q1_deg": 10.0, "q2_deg": 20.0}
pairs = {
    "ROS 2": (
        Ros2Factory,
        ros2("lab/msg/Joints", "float64 q1_deg\nfloat64 q2_deg\n", 10.0, 20.0),
        ros2("lab/msg/Joints", "float64 q2_deg\nfloat64 q1_deg\n", 20.0, 10.0),
    ),
    "Protobuf": (ProtobufFactory, protobuf(["q1_deg", "q2_deg"], **q), protobuf(["q2_deg", "q1_deg"], **q)),
}
for name, (factory, first, second) in pairs.items():
    shared = factory()
    for label, file, made, expected in (
        ("first", first, shared, (10.0, 20.0)),
        ("second", second, shared, (20.0, 10.0)),
        ("second, own factory", second, factory(), (10.0, 20.0)),
    ):
        message = decoded(file, made)[1]
        print(f"{name} {label}: q1_deg {message.q1_deg:.0f}, q2_deg {message.q2_deg:.0f}")
        assert (message.q1_deg, message.q2_deg) == expected

shared = Ros2Factory()
decoded(ros2("lab/msg/Span", SPAN, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), shared)
name, message = decoded(ros2("geometry_msgs/msg/Twist", TWIST, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0), shared)
print(f"{name}: start {message.start.x:.0f}, end {message.end.x:.0f}, linear: {hasattr(message, 'linear')}")
assert name == "geometry_msgs/msg/Twist"
assert (message.start.x, message.end.x) == (1.0, 4.0)
assert not hasattr(message, "linear")
PYTHON
