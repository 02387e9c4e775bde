#!/bin/sh
# gtsam 4.3.0: writeG2o keeps a factor that is exact as one that says nothing, and leaves priors out.
#
# A pose graph of rig, base and board often has edges that are exact: a mounting that is known, one pose for two stations
# (noiseModel.Constrained). writeG2o writes the inverse of the variance, and for an exact factor writes zero: read back by readG2o
# its sigma is infinite, so the loop that it closed is open. PriorFactorPose3 has no line in the format and is left out, so the
# graph read back floats. Neither is said: no error, no warning. Edges with sigmas come back right, translation before rotation.
#
# What is right: write exact edges with a small sigma, and add the prior again after reading.
#
# Seen: 4 factors written, 3 read; sigmas of the exact one inf; distance 0-2, optimised from a start 0.5 m off, 2.000 m before and
# 2.050 m after the file.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 gtsam==4.3.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import gtsam
import numpy as np

sigmas = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
loose = gtsam.noiseModel.Diagonal.Sigmas(sigmas)


def at(x):
    return gtsam.Pose3(gtsam.Rot3(), np.array([x, 0, 0]))


def distance(graph, start):
    graph.add(gtsam.PriorFactorPose3(0, at(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    return np.linalg.norm(found.atPose3(2).translation() - found.atPose3(0).translation())


graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
for key, x in enumerate((0, 1.1, 2.5)):
    start.insert(key, at(x))
graph.add(gtsam.PriorFactorPose3(0, at(0), loose))
graph.add(gtsam.BetweenFactorPose3(0, 1, at(1.02), loose))
graph.add(gtsam.BetweenFactorPose3(1, 2, at(1.03), loose))
graph.add(gtsam.BetweenFactorPose3(0, 2, at(2.0), gtsam.noiseModel.Constrained.All(6)))
gtsam.writeG2o(graph, start, "graph.g2o")
read, values = gtsam.readG2o("graph.g2o", True)
models = [read.at(k).noiseModel() for k in range(read.size())]
exact = models[2].sigmas()
print(f"gtsam 4.3.0: {graph.size()} factors written, {read.size()} read; sigmas of the exact one {exact}")
assert (graph.size(), read.size()) == (4, 3), "the behaviour has changed"
before, after = distance(graph, start), distance(read, values)
print(f"distance 0-2: {before:.3f} m before the file, {after:.3f} m after")
assert np.allclose(models[0].sigmas(), sigmas, rtol=1e-4) and np.isinf(exact).all(), "the behaviour has changed"
assert abs(before - 2.0) < 1e-3 and abs(after - 2.05) < 1e-3, "the behaviour has changed"
PYTHON
echo "as stated"
