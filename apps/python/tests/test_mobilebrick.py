"""One test per binding: that arguments arrive, arrays have their shapes, and errors their sentences."""

import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import HEIGHT, INTRINSICS, WIDTH, write_png

import mobilebrick as mb


def test_frames_are_lazy_arrays(sequence_path):
    sequence = mb.Sequence(sequence_path)
    assert (sequence.name, len(sequence), sequence.image_size) == ("sequence", 4, (WIDTH, HEIGHT))
    assert [frame.id for frame in sequence] == [0, 1, 2, 3]
    frame = sequence[-1]
    assert frame.id == 3
    assert frame.image.shape == (HEIGHT, WIDTH, 3) and frame.image.dtype == np.uint8
    assert frame.image[5, 7].tolist() == [24, 25, 12]
    assert frame.depth.dtype == np.float32 and np.allclose(frame.depth, 0.503)
    assert frame.confidence.min() == 2, "without a file, confidence is high"
    assert np.array_equal(frame.intrinsics, INTRINSICS)
    assert frame.world_from_cam[0, 3] == pytest.approx(0.06)
    with pytest.raises(IndexError):
        sequence[4]
    (sequence_path / "image" / "000001.png").unlink()
    assert mb.Sequence(sequence_path)[1].has_image is False


def test_errors_carry_the_librarys_sentence(sequence_path):
    with pytest.raises(mb.InputError, match="no such folder"):
        mb.Sequence(sequence_path / "nowhere")
    (sequence_path / "pose" / "000002.txt").write_text("1 2 3\n")
    with pytest.raises(ValueError, match=r"000002\.txt: line 1: 3 numbers in a row, expected 4"):
        mb.Sequence(sequence_path)
    with pytest.raises(OSError, match="cannot write"):
        mb.Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.uint32)).write("/proc/none/mesh.ply")


def test_meshes_go_in_and_out(tmp_path):
    vertices = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    mesh = mb.Mesh(vertices, np.array([[0, 1, 2]], np.uint32))
    mesh.write(tmp_path / "mesh.ply")
    back = mb.Mesh.read(tmp_path / "mesh.ply")
    assert np.array_equal(back.vertices, vertices)
    assert back.triangles.tolist() == [[0, 1, 2]] and back.triangles.dtype == np.uint32
    with pytest.raises(ValueError, match="names vertex 3"):
        mb.Mesh(vertices, np.array([[0, 1, 3]], np.uint32))


def test_depth_of_a_wall_is_exact():
    corners = np.array([[-5.0, -5.0, 2.0], [5.0, -5.0, 2.0], [5.0, 5.0, 2.0], [-5.0, 5.0, 2.0]])
    wall = mb.Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.uint32))
    pose = np.eye(4)
    pose[2, 3] = 0.5
    depth = mb.render_depth(wall, INTRINSICS, pose, (WIDTH, HEIGHT))
    assert depth.shape == (HEIGHT, WIDTH) and np.allclose(depth, 1.5)
    with pytest.raises(ValueError, match="not a rigid transform"):
        mb.render_depth(wall, INTRINSICS, 2 * pose, (WIDTH, HEIGHT))


def test_fusion_finds_the_wall(sequence_path):
    mesh, summary = mb.fuse_tsdf(mb.Sequence(sequence_path), voxel_size_mm=10, truncation_mm=40)
    assert np.abs(mesh.vertices[:, 2] - 0.503).max() < 1e-4
    assert isinstance(summary, dict) and summary
    with pytest.raises(ValueError, match="unknown field `voxels`"):
        mb.fuse_tsdf(mb.Sequence(sequence_path), voxels=3)


def test_models_have_meshes_in_metres(tmp_path):
    path = tmp_path / "brick.ldr"
    path.write_text("0 A brick\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n")
    model = mb.load_model(path)
    assert model.info()["parts"] == 1
    extent = np.ptp(model.mesh().vertices, axis=0)
    assert extent[0] == pytest.approx(0.032) and extent[2] == pytest.approx(0.016)
    assert np.ptp(model.mesh(clearance_mm=0.1).vertices, axis=0)[0] == pytest.approx(0.0318)


def test_alignments_are_matrices(sequence_path):
    with pytest.raises(mb.InputError, match="no alignment yet"):
        mb.Sequence(sequence_path).alignment()
    pose = {"rotation_wxyz": [1, 0, 0, 0], "translation_m": [1, 2, 3]}
    document = {"version": 1, "stage": "bundle", "world_from_object": pose}
    document["frames"] = [{"frame": 2, "world_from_cam": pose}]
    (sequence_path / "alignment").mkdir()
    (sequence_path / "alignment" / "alignment.json").write_text(json.dumps(document))
    alignment = mb.Sequence(sequence_path).alignment()
    assert alignment.stage == "bundle" and alignment.rms_px is None
    assert alignment.world_from_object[:3, 3].tolist() == [1, 2, 3]
    assert list(alignment.world_from_cam) == [2]


def test_views_and_depth_of_equal_folders_are_perfect(sequence_path):
    views = mb.evaluate_views(sequence_path / "image", sequence_path / "image", hold_out=2)
    assert (views["images"], views["psnr"], views["lpips"]) == (2, 100.0, None)
    depth = mb.evaluate_depth(sequence_path / "arkit_depth", sequence_path / "arkit_depth")
    assert (depth["abs_rel"], depth["delta1"]) == (0.0, 1.0)
    write_png(sequence_path / "half" / "000000.png", np.full((HEIGHT, WIDTH), 1006, np.uint16))
    assert mb.evaluate_depth(sequence_path / "arkit_depth", sequence_path / "half")["abs_rel"] == pytest.approx(1.0)


def test_images_in_memory_have_their_closed_form():
    grey = np.full((20, 30, 3), 0.25, np.float32)
    assert mb.compare_images(grey, grey + np.float32(0.1))["psnr"] == pytest.approx(20.0, abs=1e-4)
    with pytest.raises(ValueError, match="fractions from 0 to 1"):
        mb.compare_images(grey, grey * 255)
    with pytest.raises(ValueError, match="30x20"):
        mb.compare_images(grey, grey[:10])


def test_poses_are_compared_pairwise(sequence_path, tmp_path):
    (tmp_path / "other" / "pose").mkdir(parents=True)
    for i in range(4):
        pose = np.eye(4)
        pose[0, 3] = 0.021 * i
        np.savetxt(tmp_path / "other" / "pose" / f"{i:06}.txt", pose)
    scores = mb.evaluate_poses(sequence_path, tmp_path / "other")
    assert scores["rpe"]["translation_rmse_mm"] == pytest.approx(1.0)
    assert scores["object"] is None


def test_a_surface_needs_ground_truth(sequence_path, tmp_path):
    mesh = mb.Mesh(np.eye(3), np.array([[0, 1, 2]], np.uint32))
    mesh.write(tmp_path / "mesh.ply")
    with pytest.raises(mb.InputError):
        mb.evaluate_surface(sequence_path, tmp_path / "mesh.ply")
    with pytest.raises(ValueError, match="dtu-style-1"):
        mb.evaluate_surface(sequence_path, tmp_path / "mesh.ply", protocol="dtu")


def test_surfaces_in_memory_score_like_their_files(scored_path, tmp_path):
    truth = mb.Mesh.read(scored_path / "mesh" / "gt_mesh.ply")
    for protocol in ["mobilebrick-2023", "exact-1", "dtu-style-1", "tnt-style-1"]:
        options = {"protocol": protocol, "points": 2000, "thresholds_mm": [1.0]}
        moved = mb.Mesh(truth.vertices + [0, 0, 0.002], truth.triangles)
        moved.write(tmp_path / "moved.ply")
        scores = mb.evaluate_surface(scored_path, moved, **options)
        from_file = mb.evaluate_surface(scored_path, tmp_path / "moved.ply", **options)
        assert [t["threshold_mm"] for t in scores["thresholds"]] == [1.0, 2.5, 5.0]
        assert scores["chamfer_mm"] == pytest.approx(from_file["chamfer_mm"], abs=1e-3)
        assert from_file["provenance"]["prediction"]["path"] == str(tmp_path / "moved.ply")
    exact = mb.evaluate_surface(scored_path, moved, protocol="exact-1", points=2000)
    assert exact["chamfer_mm"] == pytest.approx(4.0, abs=1e-3) and exact["aligned"]["chamfer_mm"] < 1e-3
    cloud = mb.evaluate_surface(scored_path, mb.Mesh(truth.vertices), protocol="exact-1", points=2000)
    assert cloud["pred_to_gt_mm"] == 0 and "point cloud" in cloud["warnings"][0]
    with pytest.raises(mb.InputError, match="the given mesh: the prediction is in millimetres"):
        mb.evaluate_surface(scored_path, mb.Mesh(truth.vertices * 1000, truth.triangles))


def test_depth_in_memory_has_its_closed_form():
    depth = np.full((6, 8), 2.0, np.float32)
    depth[0] = np.nan
    scores = mb.compare_depth(depth, depth * np.float32(1.25))
    assert (scores["valid_pixels"], scores["abs_rel"], scores["delta1"]) == (40, 0.25, 0.0)
    with pytest.raises(ValueError, match="no pixel"):
        mb.compare_depth(depth, depth * 0)
    with pytest.raises(ValueError, match="8x6"):
        mb.compare_depth(depth, depth[:5])


def test_sequences_travel_to_other_processes(sequence_path):
    back = pickle.loads(pickle.dumps(mb.Sequence(sequence_path)))
    assert (back.path, len(back)) == (sequence_path, 4)


def test_other_threads_run_meanwhile():
    image = np.random.default_rng(0).random((1440, 1920, 3), np.float32)
    ticks = []
    stop = threading.Event()

    def tick():
        while not stop.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    ticker = threading.Thread(target=tick)
    ticker.start()
    for _ in range(5):
        mb.compare_images(image, image)
    stop.set()
    ticker.join()
    assert len(ticks) > 5


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_stops_a_call(tmp_path):
    x = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    for i in range(300):
        write_png(tmp_path / "views" / f"{i:06}.png", x) if i == 0 else os.link(
            tmp_path / "views" / "000000.png", tmp_path / "views" / f"{i:06}.png"
        )
    code = "import mobilebrick, sys; print('go', flush=True)\nwhile True: mobilebrick.evaluate_views(sys.argv[1], sys.argv[1])"
    child = subprocess.Popen(
        [sys.executable, "-c", code, tmp_path / "views"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert child.stdout.readline() == b"go\n"
    time.sleep(0.5)
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=60)
    assert b"KeyboardInterrupt" in errors


def test_the_examples_run(scored_path, monkeypatch, capsys):
    readme = (Path(__file__).parent.parent / "README.md").read_text()
    quick_start, scores = re.findall(r"```python\n(.*?)```", readme, re.S)
    assert len([line for line in quick_start.splitlines() if line]) == 10
    monkeypatch.chdir(scored_path.parent)
    exec(compile(quick_start, "README.md", "exec"), {})
    assert "is covered by Mesh(" in capsys.readouterr().out
    shutil.copy(scored_path / "mesh" / "gt_mesh.ply", "prediction.ply")
    exec(compile(scores, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "5.0 mm: F1 1.0" in printed
    assert float(printed.splitlines()[-1]) == pytest.approx(0.01, rel=1e-4)


def test_the_stubs_name_everything():
    stubs = (Path(mb.__file__).parent / "__init__.pyi").read_text()
    for name in mb.__all__:
        assert re.search(rf"^(class|def) {name}\b|^{name}:", stubs, re.M), name
    for kind in [mb.Sequence, mb.Frame, mb.Alignment, mb.Mesh, mb.Model]:
        for member in vars(kind):
            assert member.startswith("_") or f"def {member}(" in stubs, f"{kind.__name__}.{member}"
