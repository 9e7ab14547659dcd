"""Option `--scenario` with several scenarios: output, files and checkpoints."""

import json


def test_several_scenarios_are_evaluated_and_mixed(torchcover, scenes):
    (scenes / "plain.yaml").write_text((scenes / "yard.yaml").read_text().replace("name: yard", "name: plain"))
    (scenes / "out" / "yard").mkdir(parents=True)
    mixture = f"{scenes / 'yard.yaml'}=3,{scenes / 'plain.yaml'}=1"
    rigs = [scenes / f"{rig}.yaml" for rig in ("low", "both")]
    options = [
        "--scenario",
        mixture,
        "--num-frames",
        2,
        "--set",
        "cell_m=4",
        "--num-rays",
        512,
        "--out",
        scenes / "out",
    ]
    code, printed, stderr = torchcover("compare", *rigs, *options, "--files", "numbers", "--resume")
    assert code == 0
    assert stderr.count("checkpoint.npz does not exist") == 2
    assert "The weights are fixed, so confidence intervals cover" in " ".join(printed.split())
    titles = [line.strip("─ \n") for line in printed.splitlines() if line.startswith("──")]
    assert titles == ["yard", "plain", "mixture"]
    summary = json.loads((scenes / "out" / "summary.json").read_text())
    assert summary["complete"] is True
    assert [scenario["weight"] for scenario in summary["scenarios"].values()] == [0.75, 0.25]
    assert (scenes / "out" / "plain" / "checkpoint.npz").is_file()
    # What is complete and not to be gone on with takes its checkpoints away.
    assert torchcover("compare", *rigs, *options, "--files", "numbers")[0] == 0
    assert not list(scenes.glob("out/*/checkpoint.npz"))
    code, _, stderr = torchcover("evaluate", rigs[0], "--scenario", "urban=1,urban=2")
    assert code == 2
    assert stderr.strip() == "torchcover: scenario: different names are needed (case is ignored); got urban, urban"
