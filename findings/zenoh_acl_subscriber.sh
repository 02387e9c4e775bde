#!/bin/sh
# eclipse-zenoh 1.10.2: with access control, a session's put arrives and a declared publisher's put of the same key does not.
#
# A router denies by default and allows its clients all messages below site/a, ingress and egress. The router's own session
# subscribes to site/*/state, which is wider than the rule. Session.put("site/a/state") of a client arrives; the put of
# declare_publisher("site/a/state") is lost, and no side reports it: a publisher asks who subscribes, the declaration of the
# wider subscriber may not be sent to the client, and the publisher drops what nobody seems to want. A subscriber to
# site/a/** beside it makes both arrive.
#
# Seen: put 1 of 1, publisher 0 of 1; with site/a/** beside: 1 of 1, 1 of 1.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet eclipse-zenoh==1.10.2
"$folder/venv/bin/python" - <<'PYTHON'
import json
import socket
import time

import zenoh

MESSAGES = ["put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"]


def opened(mode, **settings):
    config = zenoh.Config()
    for key, value in {"mode": mode, "scouting/multicast/enabled": False, "scouting/gossip/enabled": False, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def received(publisher, beside):
    """How many of one put the subscriber to site/*/state receives; ``beside``: whether site/a/** is subscribed to as well."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    rule = {"id": "r", "permission": "allow", "messages": MESSAGES, "flows": ["ingress", "egress"], "key_exprs": ["site/a/**"]}
    access = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule],
        "subjects": [{"id": "s", "link_protocols": ["tcp"]}],
        "policies": [{"rules": ["r"], "subjects": ["s"]}],
    }
    router, got = opened("router", **{"listen/endpoints": [address], "access_control": access}), []
    subscriber = router.declare_subscriber("site/*/state", lambda sample: got.append(1))
    other = router.declare_subscriber("site/a/**", lambda sample: None) if beside else None
    client = opened("client", **{"connect/endpoints": [address]})
    put = client.declare_publisher("site/a/state").put if publisher else lambda data: client.put("site/a/state", data)
    time.sleep(0.5)
    put(b"1")
    time.sleep(0.5)
    client.close()
    router.close()
    return len(got)


found = [received(publisher, beside) for beside in (False, True) for publisher in (False, True)]
print("put {} of 1, publisher {} of 1; with site/a/** beside: {} of 1, {} of 1".format(*found))
assert found == [1, 0, 1, 1]
PYTHON
