"""`--explain`: what a run left out."""

import json

RAYS = ["--num-rays", "256", "--set", "cell_m=1"]


def whats(folder):
    return {row["description"]: row for row in json.loads((folder / "summary.json").read_text())["omissions"]}


def test_static_scene_reuses_its_scan(torchcover, worlds):
    options = ["--scenario", worlds / "yard.yaml", "--num-frames", "3", *RAYS, "--explain", "--out", worlds / "out"]
    code, text, complaints = torchcover("evaluate", worlds / "low.yaml", *options)
    assert code == 0, complaints
    assert "Omissions that cannot change the result" in text
    reused = whats(worlds / "out")["sensor rays in a static scene: cast once for all frames"]
    assert (reused["count"], reused["total"]) == (2 * 8 * 30, 3 * 8 * 30)  # the first step casts them
    once = [*options[:3], "1", *options[4:]]
    assert torchcover("evaluate", worlds / "low.yaml", *once)[0] == 0
    assert not any("cast once" in what or "first scan" in what for what in whats(worlds / "out"))


def test_omissions_without_explain_are_only_in_the_summary(torchcover, worlds):
    options = ["--scenario", worlds / "yard.yaml", "--num-frames", "2", *RAYS, "--out", worlds / "out"]
    code, text, _ = torchcover("compare", worlds / "low.yaml", worlds / "both.yaml", *options)
    assert code == 0
    assert "Omissions" not in text
    assert whats(worlds / "out")
