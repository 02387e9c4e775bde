"""``armsight measure``: a rig and shots of a target in; the target's pose shot by shot out, with its uncertainty."""
