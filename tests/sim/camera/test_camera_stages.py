"""The stages' parameters: presets, files that change them, and what is rejected."""

from dataclasses import replace

import pytest

from armsight.errors import InputError
from armsight.sim.camera.stages import STAGES, CameraPipeline, Jpeg, Sharpening, Vignetting, preset_names

SENSOR = """
[sensor]
white_e = 900.0
full_well_e = 1000.0
read_noise_e = 3
prnu = 0.0
dsnu_e = 0.0
hot_share = 0.0
hot_e = 0.0
bits = 10
dark_level = 0.0
"""


def written(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_presets_load_and_have_what_their_names_say():
    webcams = ("webcam-1080p", "webcam-good-light", "webcam-poor-light")
    assert preset_names() == (
        "clean",
        "cheap-webcam",
        "global-shutter-mjpeg",
        "industrial",
        "raspberry-pi-rolling",
        *webcams,
    )
    found = {name: CameraPipeline.load(name) for name in preset_names()}
    assert [name for name in STAGES if getattr(found["clean"], name) is not None] == ["white_noise"]
    industrial = found["industrial"]
    assert industrial.shutter(720).row_s == 0
    assert industrial.mosaic is industrial.tone is industrial.sharpening is industrial.jpeg is None
    good, poor, cheap = (found[name] for name in ("webcam-good-light", "webcam-poor-light", "cheap-webcam"))
    assert poor.sensor.white_e < good.sensor.white_e
    assert poor.denoise.sigma_grey > good.denoise.sigma_grey
    assert poor.auto_exposure == good.auto_exposure  # the same camera
    assert cheap.jpeg.quality < poor.jpeg.quality < good.jpeg.quality
    assert cheap.resizing.native_scale < 1


def test_every_stage_is_a_table_of_the_file_and_a_field_of_the_camera():
    assert list(STAGES) == list(CameraPipeline.__dataclass_fields__)


def test_a_file_changes_a_preset_key_by_key_and_leaves_stages_out(tmp_path):
    text = 'preset = "webcam-good-light"\njpeg = false\nglint = false\n[sharpening]\namount = 1.5\n'
    base = CameraPipeline.load("webcam-good-light")
    assert CameraPipeline.load(written(tmp_path, text)) == replace(base, jpeg=None, sharpening=Sharpening(1.5, 1.0))


def test_a_file_may_have_stages_of_its_own(tmp_path):
    found = CameraPipeline.load(written(tmp_path, "[vignetting]\ncorner = 0.3\n"))
    assert found == CameraPipeline(vignetting=Vignetting(0.3))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[vignetting\n", "not TOML"),
        ("[vigneting]\ncorner = 0.3\n", "unknown stage 'vigneting'; known are preset, timing, lens, lamp"),
        ("[vignetting]\ncorners = 0.3\n", r"\[vignetting\] has an unknown key 'corners'; known are corner"),
        ("[vignetting]\ncorner = 1.5\n", r"\[vignetting\] corner must be a number from 0 to 0.9, got 1.5"),
        ("[vignetting]\ncorner = nan\n", "corner must be a number"),
        ("[vignetting]\ncorner = true\n", "corner must be a number"),
        ("[vignetting]\ncorner = [0.3]\n", "corner must be a number"),
        ("vignetting = 0.3\n", r"vignetting must be a table \[vignetting\]"),
        ("[sharpening]\namount = 1.0\n", r"\[sharpening\] lacks sigma_px"),
        ('[jpeg]\nquality = 80.5\nchroma = "4:2:0"\n', "quality must be a whole number from 1 to 100, got 80.5"),
        ('[jpeg]\nquality = 80\nchroma = "4:1:1"\n', "chroma must be one of 4:4:4, 4:2:2, 4:2:0, got '4:1:1'"),
        ("[glint]\npeak = 1\nsigma_px = 2\ncentre = [0.5]\n", "centre must be a list of 2 numbers, each from -1 to 2"),
        ('preset = "webcam"\n', "preset is 'webcam'; known are clean, cheap-webcam"),
        (SENSOR + "[white_noise]\nsigma_grey = 2.0\n", "exclude each other"),
        ("[auto_exposure]\ntarget = 0.2\nstep_ev = 0.3\ngain_max = 8\n", "auto_exposure needs the stage sensor"),
    ],
)
def test_what_a_file_must_not_say(tmp_path, text, said):
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=said) as caught:
        CameraPipeline.load(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_name_that_is_not_known_and_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"camera 'leica' is unknown; known are clean, .*, or a TOML file"):
        CameraPipeline.load("leica")
    with pytest.raises(InputError, match="no such file"):
        CameraPipeline.load(tmp_path / "none.toml")


def test_values_are_checked_in_python_too():
    with pytest.raises(InputError, match="quality must be"):
        Jpeg(0, "4:2:0")
