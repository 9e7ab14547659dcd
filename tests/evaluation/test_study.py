"""Study of error against run time: trials agree with evaluations, and recommendations reach the error."""

import json
import math
from dataclasses import replace

import pytest

from torchcover.coverage.quantities import make_detection_quantity
from torchcover.estimation import ErrorModel
from torchcover.evaluation import Settings, StudyPlan, Trial, evaluate, measure_error_against_time
from torchcover.evaluation.study import StudiedNumber, Study
from torchcover.simulation import Rig

DETECTION = make_detection_quantity(0.4)
SMALL = Settings("front_roof_32", "courtyard", num_frames=8, cell_m=4.0, num_rays=256)


@pytest.fixture(autouse=True)
def _skip_command(monkeypatch):
    monkeypatch.setattr("torchcover.evaluation.study.measure_command_s", lambda plan: 100.0)


@pytest.fixture(scope="module")
def study():
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("torchcover.evaluation.study.measure_command_s", lambda plan: 100.0)
        return measure_error_against_time(
            StudyPlan(SMALL, ({"num_rays": 64}, {"reference": "paper", "num_rays": 1024}))
        )


def make_trial(coefficient, duration_s=64.0, bias=0.0, options="", min_frames=64):
    """Make a trial of 64 frames with one number that has a target and one without."""
    error = ErrorModel(coefficient, bias)
    without_target = StudiedNumber("3m", "ground", False, DETECTION, 0.5, ErrorModel(9.0), None, False)
    with_target = StudiedNumber("20m", "ground", True, DETECTION, 0.5, error, None, False)
    return Trial(options, 64, min_frames, duration_s, duration_s, "ground", [with_target, without_target])


@pytest.mark.parametrize("coefficient", [0.01, 0.36, 25.0])
def test_error_model_decreases_to_the_bias(coefficient):
    model = ErrorModel(coefficient, bias=0.003)
    assert model.estimate_error(10**12) == pytest.approx(0.003, rel=1e-3)
    assert ErrorModel(coefficient).estimate_error(400) == pytest.approx(
        0.5 * ErrorModel(coefficient).estimate_error(100), rel=1e-12
    )
    num_frames = model.estimate_num_frames(0.01)
    assert model.estimate_error(num_frames) <= 0.01 < model.estimate_error(num_frames - 1) or num_frames == 1
    assert model.estimate_num_frames(0.003) is None
    assert ErrorModel(math.nan).estimate_num_frames(0.01) is None
    assert ErrorModel.from_error(ErrorModel(coefficient).estimate_error(77), 77).error_coefficient == pytest.approx(
        coefficient, rel=1e-12
    )


def test_trial_has_the_numbers_of_an_evaluation(study):
    baseline, variant, _ = study.trials
    # A variant has at least 8 blocks, which are all blocks here.
    for trial, num_rays in ((baseline, 256), (variant, 64)):
        coverage = evaluate(*SMALL.rigs, "courtyard", num_frames=8, cell_m=4.0, num_rays=num_rays).coverage
        rows = {(row.region, row.band): row.numbers for row in coverage.summary()}
        for studied in trial.numbers:
            number = rows[studied.region, studied.band][studied.quantity.key]
            assert (studied.value == number.value) or math.isnan(studied.value)
            if not math.isnan(number.error):
                expected = math.hypot(number.error, studied.error.bias)
                assert studied.error.estimate_error(8) == pytest.approx(expected, rel=1e-9)
    assert all(number.difference is None and number.error.bias == 0.0 for number in baseline.numbers)
    assert any(number.difference.value != 0.0 for number in variant.numbers)


def test_different_averages_have_no_difference(study):
    paper = study.trials[2]
    assert all(math.isnan(number.difference.value) and math.isnan(number.error.bias) for number in paper.numbers)
    assert paper.estimate_num_frames(0.02) is None


def test_times_include_the_startup_of_the_command(study):
    first = study.trials[0]
    assert first.estimate_duration_s(16, study.startup_s) - first.estimate_duration_s(
        8, study.startup_s
    ) == pytest.approx(first.duration_s)
    assert study.startup_s == pytest.approx(100.0 - first.duration_s / 8)
    assert first.cpu_s > 0


def test_largest_error_determines_the_number_of_frames():
    assert make_trial(0.04).estimate_num_frames(0.01) == 400
    assert make_trial(0.0004).estimate_num_frames(0.01) == 64  # fewer frames give no error
    assert make_trial(0.0123456).estimate_num_frames(0.01) == 130  # rounded up to two digits
    assert make_trial(math.nan).estimate_num_frames(0.01) is None
    assert make_trial(0.04, bias=0.02).estimate_num_frames(0.01) is None


def test_variant_is_recommended_if_it_saves_a_fifth():
    plan = StudyPlan(SMALL)
    for duration_s, expected in ((60.0, ""), (40.0, "--set num_rays=64")):
        recommended = Study(
            plan, [make_trial(0.04), make_trial(0.04, duration_s, options="--set num_rays=64")], 1.0
        ).find_recommended(0.01)
        assert (recommended[0].options, recommended[1]) == (expected, 400)
    biased = Study(plan, [make_trial(0.04), make_trial(0.04, 1.0, bias=0.02, options="--set num_rays=64")], 1.0)
    assert biased.find_recommended(0.01)[0].options == ""
    assert Study(plan, [make_trial(math.nan)], 1.0).find_recommended(0.01) is None
    assert Study(plan, [make_trial(math.nan)], 1.0).format_recommendation(0.01) == (
        "Standard error of 1 percentage point for every detection rate: unknown; 64 frames give no standard error of "
        "20m ground."
    )
    assert Study(plan, [make_trial(0.04)], 1.0).format_recommendation(0.01) == (
        "Standard error of 1 percentage point for every detection rate: front_roof_32 --set scenario=courtyard "
        "--set cell_m=4.0 --set num_rays=256 --num-frames=400 (401 s)."
    )


def test_only_significant_bias_counts(study):
    for number in study.trials[1].numbers:
        if not math.isnan(number.difference.value):
            assert number.is_biased is (number.difference.p_value * len(study.trials[1].numbers) < 0.05)
            assert number.error.bias == (abs(number.difference.value) if number.is_biased else 0.0)


def test_record_is_json_without_nan(study, tmp_path):
    paths = study.save(tmp_path / "out")
    assert [path.name for path in paths] == ["work_precision.png", "summary.json"]
    record = json.loads(json.dumps(study.record, allow_nan=False))
    assert [trial["options"] for trial in record["trials"]] == [
        "",
        "--set num_rays=64",
        "--set reference=paper --set num_rays=1024",
    ]
    assert [trial["band_frame"] for trial in record["trials"]] == ["ground", "ground", "vehicle"]
    assert [item["error"] for item in record["recommended"]] == [0.02, 0.01, 0.005]


def test_timed_command_has_all_changed_options():
    settings = Settings(
        "rig", "urban", cell_m=0.5, thresholds_m=(0.2, 1), frame_interval_s=5.0, num_frames=7, num_workers=2
    )
    assert StudyPlan(settings).command == [
        "evaluate", "rig", *("--set", "scenario=urban"), *("--set", "cell_m=0.5"), *("--set", "thresholds_m=0.2,1.0"),
        *("--set", "frame_interval_s=5.0"), *("--set", "num_workers=2"),
    ]  # fmt: skip
    assert StudyPlan(replace(settings, num_frames=None)).trial_settings[""].num_frames == 512


@pytest.mark.parametrize("settings", [Settings(), Settings(Rig.load("front_roof_32"))])
def test_plan_without_names_is_rejected(settings):
    with pytest.raises(ValueError, match="one rig and a scenario are needed, by names or paths"):
        StudyPlan(settings)


def test_interrupted_study_raises(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchcover.evaluation.observers.CoverageObserver.add_sums", interrupted)
    with pytest.raises(KeyboardInterrupt):
        measure_error_against_time(StudyPlan(SMALL))
