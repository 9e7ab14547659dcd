"""Option `--explain`: omissions of a run."""

import json

RAYS = ["--num-rays", "256", "--set", "cell_m=1"]


def whats(folder):
    return {row["description"]: row for row in json.loads((folder / "summary.json").read_text())["omissions"]}


def test_static_scene_reuses_its_scan(torchcover, scenes):
    options = ["--scenario", scenes / "yard.yaml", "--num-frames", "3", *RAYS, "--explain", "--out", scenes / "out"]
    code, text, stderr = torchcover("evaluate", scenes / "low.yaml", *options)
    assert code == 0, stderr
    assert "Omissions that cannot change the result" in text
    reused = whats(scenes / "out")["sensor rays in a static scene: cast once for all frames"]
    assert (reused["count"], reused["total"]) == (2 * 8 * 30, 3 * 8 * 30)  # the first frame casts them
    once = [*options[:3], "1", *options[4:]]
    assert torchcover("evaluate", scenes / "low.yaml", *once)[0] == 0
    assert not any("cast once" in what or "first scan" in what for what in whats(scenes / "out"))


def test_omissions_without_explain_are_only_in_the_summary(torchcover, scenes):
    options = ["--scenario", scenes / "yard.yaml", "--num-frames", "2", *RAYS, "--out", scenes / "out"]
    code, text, _ = torchcover("compare", scenes / "low.yaml", scenes / "both.yaml", *options)
    assert code == 0
    assert "Omissions" not in text
    assert whats(scenes / "out")
