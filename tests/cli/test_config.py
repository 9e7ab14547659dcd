"""Settings of a run from a file, from `--set` and from options."""

import json

import pytest
import typer

from torchcover.cli.app import app
from torchcover.data import RecordingSettings, open_recording
from torchcover.evaluation.config import EvaluateConfig, format_defaults, load_config
from torchcover.files import BadFileError, parse_yaml
from torchcover.simulation.document_keys import KINDS, SETTINGS_KIND


def test_printed_defaults_have_a_comment_for_every_setting(tmp_path):
    text = format_defaults()
    (tmp_path / "run.yaml").write_text(text)
    assert load_config(tmp_path / "run.yaml").config == EvaluateConfig()
    assert list(parse_yaml(text)) == list(EvaluateConfig.model_fields)
    assert not load_config(tmp_path / "run.yaml").config.recording.model_fields_set
    lines = text.splitlines()
    keys = [number for number, line in enumerate(lines) if not line.startswith("#")]
    assert all(lines[number - 1].startswith("#") for number in keys)
    assert set(KINDS[SETTINGS_KIND][1].split()) == set(EvaluateConfig.model_fields)
    section = text.partition("recording: {}")[2].replace("\n#", "\n")
    assert list(parse_yaml(f"recording:{section}")["recording"]) == list(RecordingSettings.model_fields)


def test_options_precede_set_which_precedes_the_file(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("num_rays: 1\ncell_m: 1.0\nseed: 1\nrecording: {units: mm, time_offset_s: 0.2}\n")
    config, record = load_config(path, ["num_rays=2", "cell_m=2", "recording.units=cm"], {"num_rays": 3})
    assert (config.num_rays, config.cell_m, config.seed) == (3, 2.0, 1)
    assert (config.recording.units, config.recording.time_offset_s) == ("cm", 0.2)
    assert record["file"] == str(path)
    assert record["settings"]["num_rays"] == 1
    assert record["replaced"]["num_rays"] == {"file": 1, "option": 3}
    assert "seed" not in record["replaced"]
    assert load_config(None, ["num_rays=2"]).record == {}
    lists = load_config(
        None, ["aggregations=[maximum, 'quantiles:0.5,0.9']", "test_targets=child,pole", "thresholds_m=1,2"]
    ).config
    assert lists.aggregations == ("maximum", "quantiles:0.5,0.9")
    assert (lists.test_targets, lists.thresholds_m) == (("child", "pole"), (1.0, 2.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rayz: 3", "rayz: unknown key"),
        ("num_rays: 3\nnum_rays: 4", "rays"),
        ("num_rays: many", "num_rays: an integer is needed; got 'many'"),
        ("num_rays: 1.5", "num_rays: an integer is needed; got 1.5"),
        ("cell_m: 25cm", "cell_m: a number is needed; got '25cm'"),
        ("thresholds_cm: [40]", "thresholds_cm: unknown key"),
        ("redundancy: 1", "redundancy: true or false is needed; got 1"),
        ("target_error: 1%", "target_error: a list is needed; got '1%'"),
        ("recording: {units: km}", "recording.units: 'm', 'cm', 'mm' or 'ft' is needed; got 'km'"),
        ("recording: {time_offset_s: 5}", "recording.time_offset_s: at most 1 s of time offset"),
        ("[1, 2]", "a YAML mapping of settings is needed"),
        ("name: r\nsensors: []", "this is a rig; a file of settings is needed"),
    ],
)
def test_error_of_a_file_names_key_and_value(tmp_path, text, message):
    path = tmp_path / "run.yaml"
    path.write_text(text)
    with pytest.raises(BadFileError) as refused:
        load_config(path)
    assert str(path) in str(refused.value)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    "text", ["rays", "=", "rayz=3", "recording=1", "recording.unit=mm", "num_rays=x", "cell_m=25cm"]
)
def test_invalid_assignment_is_rejected(text):
    with pytest.raises(ValueError, match=r"^--set "):
        load_config(None, [text])


def test_result_contains_the_file_of_settings(torchcover, scenes):
    path = scenes / "run.yaml"
    path.write_text(f"scenario: {scenes / 'yard.yaml'}\ncell_m: 4\nnum_rays: 64\nnum_frames: 3\ntest_targets: [none]\n")
    options = ("--config", path, "--num-frames", 2, "--files", "numbers", "--out", scenes / "out")
    code, _, stderr = torchcover("evaluate", scenes / "both.yaml", *options)
    assert code == 0, stderr
    summary = json.loads((scenes / "out" / "summary.json").read_text())
    assert summary["rows"][0]["num_frames"] == 2
    assert summary["config"]["settings"]["cell_m"] == 4
    assert summary["config"]["replaced"]["num_frames"] == {"file": 3, "option": 2}
    code, printed, _ = torchcover("config")
    assert (code, printed) == (0, format_defaults())


def test_settings_precede_recording_yaml(tmp_path):
    recording = tmp_path
    for source in ("sensor", "reference"):
        (tmp_path / source).mkdir()
        (tmp_path / source / "frame0.xyz").write_text("1 2 3")
    (recording / "recording.yaml").write_text("units: cm\n")
    plain = open_recording(recording)
    assert plain.settings.command_line_options == "--set recording.units=cm"
    assert (
        open_recording(recording, RecordingSettings(units="m")).read_scan("sensor", 0).points_m.tolist()
        == (100 * plain.read_scan("sensor", 0).points_m).tolist()
    )
    (recording / "recording.yaml").write_text("unit: cm\n")
    with pytest.raises(BadFileError, match=r"recording\.yaml: .*unit: unknown key"):
        open_recording(recording)


def test_evaluate_has_at_most_22_options():
    command = typer.main.get_command(app).commands["evaluate"]
    assert sum(parameter.param_type_name == "option" for parameter in command.params) <= 22
