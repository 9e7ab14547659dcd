"""`--scenario` with several kinds of world: what is printed, written, and gone on with."""

import json


def test_several_scenarios_are_evaluated_and_mixed(torchcover, worlds):
    (worlds / "plain.yaml").write_text((worlds / "yard.yaml").read_text().replace("name: yard", "name: plain"))
    (worlds / "out" / "yard").mkdir(parents=True)
    mixture = f"{worlds / 'yard.yaml'}=3,{worlds / 'plain.yaml'}=1"
    rigs = [worlds / f"{rig}.yaml" for rig in ("low", "both")]
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
        worlds / "out",
    ]
    code, printed, told = torchcover("compare", *rigs, *options, "--files", "numbers", "--resume")
    assert code == 0
    assert told.count("checkpoint.npz does not exist") == 2
    assert "given, not drawn" in " ".join(printed.split())
    titles = [line.strip("─ \n") for line in printed.splitlines() if line.startswith("──")]
    assert titles == ["yard", "plain", "mixture"]
    summary = json.loads((worlds / "out" / "summary.json").read_text())
    assert summary["complete"] is True
    assert [world["weight"] for world in summary["scenarios"].values()] == [0.75, 0.25]
    assert (worlds / "out" / "plain" / "checkpoint.npz").is_file()
    # What is complete and not to be gone on with takes its checkpoints away.
    assert torchcover("compare", *rigs, *options, "--files", "numbers")[0] == 0
    assert not list(worlds.glob("out/*/checkpoint.npz"))
    code, _, told = torchcover("evaluate", rigs[0], "--scenario", "urban=1,urban=2")
    assert code == 2
    assert told.strip() == "torchcover: scenario: different names are needed (case is ignored); got urban, urban"
