"""A camera's images of the workcell: against rays and the renderer, disc centres, and what covers what."""

import numpy as np
import pytest
from render_oracle import brute

from armsight.geometry.pose import exp_se3, inverse, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.robot.arm_file import open_arm
from armsight.sim.render.optics import Sensor, exposed, noise_start, noise_strip, shaded
from armsight.sim.render.render import Shutter, radiance
from armsight.sim.render.scene import PosedBody, plate
from armsight.sim.workcell.body import body_patterns, body_target
from armsight.sim.workcell.cameras import open_rig, rig_pose
from armsight.sim.workcell.images import LENS, ArmSeen, WorkcellCamera, moving
from armsight.sim.workcell.motors import row_frames, solids
from disc_rims import ellipse_through, rim
from views import pixels

MODEL = open_arm("six_r")
PARTS = solids(MODEL)
SIZE = (960, 540)
QUIET = np.zeros(1 << 20, np.float32)
STILL = Shutter()


@pytest.fixture(scope="module")
def camera():
    rig = open_rig("parallel", SIZE)
    T_base_rig = rig_pose(MODEL, rig, pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.03])), 0)
    return WorkcellCamera(rig.left, T_base_rig, PARTS, 0, sensor=Sensor(read_noise=0.0))


def somewhere(rng, tilt=0.25):
    """A pose before the camera, its patterns in view."""
    p = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.08, 0.08), rng.uniform(0.6, 1.1)])
    return pose(exp_so3(rng.normal(0, tilt, 3)), p)


@pytest.mark.parametrize("exposure_s", [0.0, 0.004])
def test_a_pattern_is_painted_as_rays_through_every_pixel_see_it(camera, exposure_s):
    """By brute force, as the mean over moments of the exposure, where the pattern alone is seen; then lens and sensor."""
    rng, sensor = np.random.default_rng(5), Sensor(read_noise=0.0)
    vignetting = shaded(np.ones(SIZE[::-1], np.float32), LENS)
    twist = np.array([0.4, -0.2, 0.3, 0.5, -0.6, 0.7])  # 4 px in 4 ms
    moments = exposure_s * ((np.arange(9) + 0.5) / 9 - 0.5) if exposure_s else [0.0]
    for face in body_patterns()[:2]:
        T = somewhere(rng)
        image = camera.image(None, [PosedBody((face,), T, twist)], Shutter(exposure_s), QUIET, 0)
        x, y, _, _ = face.discs[0]
        u, v = pixels(camera.camera, transform(T @ face.T_body_pattern, np.array([[x, y, 0.0]])))[0].astype(int)
        window = u - 9, v - 7, u + 9, v + 7

        def light(ground, samples, window=window, face=face, T=T):
            seen = [
                brute(camera.camera, [(face, T @ exp_se3(t_s * twist))], window, 0.7, ground, samples)
                for t_s in moments
            ]
            return np.mean(seen, axis=0)

        covered = np.abs(light(0.0, 4) - light(1.0, 4)) < 1e-9
        part = np.s_[window[1] : window[3], window[0] : window[2]]
        expected = sensor.gain * vignetting[part] * light(0.0, 16 if exposure_s else 32) + sensor.offset
        assert covered.mean() > 0.5
        assert np.ptp(expected[covered]) > 50  # the disc and what is around it
        # Rounding takes half a level; the samples of a pixel, and nine moments, take less than the other half.
        assert np.abs(image[part] - expected)[covered].max() <= 1.0


@pytest.mark.parametrize("shutter", [STILL, Shutter(0.002), Shutter(0.004, 2e-5)])
def test_a_pattern_is_painted_as_the_renderer_paints_it(camera, shutter):
    """The renderer paints the whole image with more parts of the exposure; here only what the pattern covers."""
    rng = np.random.default_rng(1)
    twist = np.array([0.4, -0.2, 0.3, 0.5, -0.6, 0.7]) * (shutter.exposure_s > 0)
    for k in range(4):
        posed = [PosedBody(body_patterns()[k : k + 1], somewhere(rng), twist)]
        image = camera.image(None, posed, shutter, QUIET, 0)
        light = radiance(camera.camera, posed, camera.still.light.copy(), psf_sigma_px=0.7, shutter=shutter)
        oracle = exposed(shaded(light, LENS), Sensor(read_noise=0.0), None)
        assert np.abs(image.astype(int) - oracle).max() <= 1


@pytest.mark.parametrize("exposure_s", [0.0, 0.002])
def test_disc_centres_are_where_they_belong(camera, exposure_s):
    """The centroid of a disc's light is the middle of its ellipse, and of the ellipses along its way where it moves."""
    rng = np.random.default_rng(2)
    gain = shaded(np.ones(SIZE[::-1], np.float32), LENS)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    shutter, discs, errors = Shutter(exposure_s), body_target().discs, []
    for k in range(24):
        T, i = somewhere(rng), k % 9
        twist = rng.normal(0, 1, 6) * (0.3, 0.3, 0.2, 0.5, 0.5, 0.5) * (exposure_s > 0)
        disc = next(d for face in body_patterns() for d in face.discs if d[2] == discs.radii_m[i])
        plain, spotted = plate(0.1, 0.1, 0.06, []), plate(0.1, 0.1, 0.06, [disc])
        lights = [camera.image(None, [PosedBody((p,), T, twist)], shutter, QUIET, 0) / gain for p in (spotted, plain)]
        light = lights[0] - lights[1]
        centroid = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
        path = [exp_se3(0.5 * exposure_s * x * twist) for x in (-(0.6**0.5), 0.0, 0.6**0.5)]
        at = np.array([*disc[:2], 0.0])
        rims = [transform(T @ X, rim(at, np.array([0, 0, -1.0]), disc[2])) for X in path]
        seen = [ellipse_through(pixels(camera.camera, points))[0] for points in rims]
        errors.append(centroid - np.average(seen, axis=0, weights=(5, 8, 5)))
    # Rounding to whole levels alone makes 0.29 sqrt(sum r^2) / sum of light = 0.002 px of a disc of 6 px.
    assert np.sqrt(np.mean(np.square(errors))) < 0.003


def test_an_arm_hides_what_is_behind_it_and_not_what_is_before(camera):
    arm = ArmSeen(PARTS, row_frames(MODEL, MODEL.home))
    bare = camera.image(arm, [], STILL, QUIET, 0)
    ids = camera.arm_ids(arm)
    T_camera_elbow = inverse(camera.T_base_camera) @ row_frames(MODEL, MODEL.home)[3]
    away = T_camera_elbow[:3, 3] / np.linalg.norm(T_camera_elbow[:3, 3])
    sheet = plate(0.5, 0.5, 0.9, [])
    facing = pose(exp_so3(np.cross([0, 0, 1.0], away)), np.zeros(3))[:3, :3]
    elbow = ids > 0
    inside = np.zeros_like(elbow)
    u, v = camera.camera.project(T_camera_elbow[None, :3, 3])[0]
    inside[int(v) - 40 : int(v) + 40, int(u) - 40 : int(u) + 40] = True
    for shift, hidden in ((0.6, True), (-0.7, False)):  # beyond the whole arm; before all of it
        posed = [PosedBody((sheet,), pose(facing, T_camera_elbow[:3, 3] + shift * away))]
        image = camera.image(arm, posed, STILL, QUIET, 0)
        # Two pixels off an edge the lens mixes the two.
        kernel = np.lib.stride_tricks.sliding_window_view(np.pad(elbow, 4), (9, 9)).all(axis=(2, 3))
        same = np.abs(image.astype(int) - bare)[kernel & inside] <= 1
        assert kernel[inside].sum() > 500
        assert same.all() if hidden else not same.any()


def test_a_disc_behind_a_link_is_not_found(camera):
    """The body held behind the wrist, as the camera sees it."""
    discs = body_target().discs
    arm = ArmSeen(PARTS, row_frames(MODEL, MODEL.home))
    T_camera_wrist = inverse(camera.T_base_camera) @ row_frames(MODEL, MODEL.home)[5]
    behind = T_camera_wrist[:3, 3] * (1 + 0.15 / np.linalg.norm(T_camera_wrist[:3, 3]))
    posed = [PosedBody(body_patterns(), pose(np.eye(3), behind))]
    seen = discs.find(camera.image(None, posed, STILL, QUIET, 0))
    covered = discs.find(camera.image(arm, posed, STILL, QUIET, 0))
    uv = camera.camera.project(discs.body.points + behind)
    ids = camera.arm_ids(arm)
    hidden = np.array([ids[round(v), round(u)] > 0 for u, v in uv])
    shown, left = ((np.abs(found.uv[:, None] - uv).max(axis=2) < 2).any(axis=0) for found in (seen, covered))
    assert (shown & hidden).sum() >= 2
    assert not left[hidden].any()


def test_a_face_that_rotates_away_during_the_exposure(camera):
    """It is in some parts of the exposure and not in others."""
    T = pose(exp_so3(np.array([0.0, np.pi / 2 - 1e-4, 0.0])), np.array([0.0, 0.0, 0.8]))
    twist = np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0])
    for way in (-1.0, 1.0):
        image = camera.image(None, [PosedBody(body_patterns(), T, way * twist)], Shutter(0.004), QUIET, 0)
        assert (image != camera.image(None, [], STILL, QUIET, 0)).any()


def test_noise_is_as_strong_as_asked_and_another_in_every_image():
    rig = open_rig("parallel", (320, 240))
    T = rig_pose(MODEL, rig, pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.03])), 0)
    noisy = WorkcellCamera(rig.left, T, PARTS, 0, sensor=Sensor(read_noise=2.0))
    strip = noise_strip(0, (320, 240))
    images = [noisy.image(None, [], STILL, strip, noise_start(0, 0, k)).astype(float) for k in (0, 1, 0)]
    assert (images[0] == images[2]).all()
    difference = images[0] - images[1]
    # Twice the noise's variance and twice that of rounding; 76800 differences determine a deviation to 0.3 %.
    assert difference.std() == pytest.approx(np.sqrt(2 * (4 + 1 / 12)), rel=0.02)


def test_nothing_in_view_is_what_stands_still(camera):
    away = [PosedBody(body_patterns(), pose(np.eye(3), np.array([0.0, 0.0, -1.0])))]
    assert (camera.image(None, [], STILL, QUIET, 0) == camera.image(None, away, STILL, QUIET, 0)).all()


def test_a_ball_is_rendered_though_no_tile_has_a_corner_in_it():
    v, u = np.mgrid[:64, :64]
    rays = np.stack([(u - 31.5) / 100, (v - 31.5) / 100, np.ones((64, 64))])
    rays /= np.linalg.norm(rays, axis=0)
    counts = []
    for length in (0.0, 1e-3):
        ends = np.array([[[-0.08, -0.08, 1.0], [-0.08 + length, -0.08, 1.0]]])
        light, depth, ids = np.zeros((64, 64)), np.full((64, 64), 9.0, np.float32), np.zeros((64, 64), np.int16)
        links = ends, np.array([0.06]), np.array([0.5])
        moving(rays, (0, 0, 64, 64), np.array([[0, 0, 64, 64]]), links, np.array([0.0, 0.0, -1.0]), light, depth, ids)
        counts.append(int((ids > 0).sum()))
    assert counts[0] == pytest.approx(np.pi * 6.0**2, rel=0.05)
    assert counts[1] == pytest.approx(counts[0], rel=0.06)


def test_the_light_before_the_sensor_is_what_the_image_is_made_of(camera):
    arm = ArmSeen(PARTS, row_frames(MODEL, MODEL.home))
    bodies = [PosedBody(body_patterns(), somewhere(np.random.default_rng(4)), np.array([0.3, 0.1, 0, 0, 0.5, 0]))]
    for seen in ((arm, bodies), (None, [])):
        light = camera.radiance(*seen, Shutter(0.004))
        image = camera.image(*seen, Shutter(0.004), QUIET, 0)
        expected = exposed(shaded(light, LENS), Sensor(read_noise=0.0), None)
        assert np.abs(image.astype(int) - expected).max() <= 1  # 255 is multiplied before the shading, or after
        assert (image != expected).mean() < 1e-3
