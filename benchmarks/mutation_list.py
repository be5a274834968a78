# ruff: noqa: E501
"""The changes of `benchmarks.mutations`: what each does, where, and which tests should notice."""

from __future__ import annotations

from benchmarks.mutations import Mutation as M

CORE = "mifit/core/*.py"
CAPTURE = "mifit/capture/*.py"
STAGES = "mifit/stages/**/*.py"
SOLVE = "mifit/solve/*.py"
OUTPUT = "mifit/output/*.py"
RENDER = "mifit/render/*.py"
ANY = "mifit/**/*.py"

CONVENTIONS = [
    M("pixel centres at integers", CORE, r"return np\.stack\(\[x \+ 0\.5, y \+ 0\.5\]", "return np.stack([x, y]",
      "tests/core/test_camera.py"),
    M("camera axes of OpenGL not turned", CORE, r"OPENGL_FROM_OPENCV = np\.diag\(\[1\.0, -1\.0, -1\.0, 1\.0\]\)",
      "OPENGL_FROM_OPENCV = np.diag([1.0, 1.0, 1.0, 1.0])", "tests/core/test_camera.py"),
    M("a point behind the camera projects", CORE, r"np\.where\(p\[\.\.\., 2\] > 1e-12, p\[\.\.\., 2\], np\.nan\)",
      "p[..., 2]", "tests/core/test_camera.py"),
    M("maps read upside down", CORE, r"y = np\.clip\(\(1\.0 - uv\[:, 1\]\) \* size - 0\.5", "y = np.clip(uv[:, 1] * size - 0.5",
      "tests/core/test_uv.py"),
    M("texels half a texel off", CORE, r"px, py = x \+ 0\.5, y \+ 0\.5", "px, py = x, y", "tests/core/test_uv.py"),
    M("OpenCV's principal point taken as ours", CAPTURE, r"matrix\[0, 2\] \+ 0\.5, matrix\[1, 2\] \+ 0\.5",
      "matrix[0, 2], matrix[1, 2]", "tests/capture/test_importer.py tests/capture/test_conventions.py"),
    M("lens distortion half a pixel off", CAPTURE, r"matrix\[:2, 2\] -= 0\.5", "matrix[:2, 2] -= 0.0",
      "tests/capture/test_capture.py tests/capture/test_conventions.py"),
    M("landmarks of .npy files taken as ours", CAPTURE, r'"\.npy": 0\.0', '".npy": 0.5',
      "tests/capture/test_landmark_files.py"),
    M("sRGB decoded with exponent 2.2", CORE, r"\*\* ?2\.4\b", "** 2.2", "tests/core/test_image.py"),
    M("the weak landmark threshold of alpha ignored", CAPTURE, r"valid &= found\.alpha >= 0\.5", "pass",
      "tests/capture/test_capture.py"),
    M("clipped pixels count as measured", CAPTURE, r"clipped = found\.clipped\b", "clipped = found.clipped & False",
      "tests/capture/test_capture.py"),
]  # fmt: skip

MEASURES = [
    M("PSNR of powers", CORE, r"20\.0 \* math\.log10\(peak / error\)", "10.0 * math.log10(peak / error)",
      "tests/core/test_metrics.py"),
    M("SSIM's second constant ten times larger", CORE, r"\(0\.03 \* peak\) \*\* 2", "(0.3 * peak) ** 2",
      "tests/core/test_metrics.py"),
    M("FLIP without its feature exponent", CORE, r"COLOUR_EXPONENT, FEATURE_EXPONENT = 0\.7, 0\.5",
      "COLOUR_EXPONENT, FEATURE_EXPONENT = 0.7, 1.0", "tests/core/test_flip.py"),
    M("the evaluated region isn't eroded", OUTPUT, r"^EROSION = 2$", "EROSION = 0",
      "tests/output/test_render_evaluate.py"),
    M("the baseline takes views that are hidden", RENDER,
      r"visible = inside & \(cosine > LEAST_COSINE\) & scene\.visible_from\(point, view\.position\)",
      "visible = inside & (cosine > LEAST_COSINE)", "tests/test_foreign.py tests/output/test_baseline_resect.py"),
    M("the baseline ignores gains", RENDER, r"colour = bilinear\(frame\.image, x, y\) / gain",
      "colour = bilinear(frame.image, x, y)", "tests/test_foreign.py"),
    M("a placed camera keeps a guessed focal length", OUTPUT,
      r"focal = np\.exp\(x\[6\]\) if view\.intrinsics is None else 1\.0", "focal = 1.0",
      "tests/output/test_baseline_resect.py"),
    M("distances to vertices, not to faces", "benchmarks/scan.py", r"pick = distance\.argmin\(1\)",
      "pick = distance.argmax(1)", "tests/test_foreign.py"),
    M("relit views compared without their factors", "benchmarks/judge.py",
      r"a = a \* \(a \* b\)\.sum\(0\) / np\.maximum\(\(a \* a\)\.sum\(0\), 1e-9\)", "a = a * 1.0",
      "tests/test_foreign.py"),
]  # fmt: skip

LIGHT = [
    M("irradiance without the cosine's factors", CORE, r"basis\(normals, self\.order\) @ \(factors\[:, None\] \* self",
      "basis(normals, self.order) @ (np.ones_like(factors)[:, None] * self", "tests/core/test_sh.py"),
    M("the basis without the Condon-Shortley phase", CORE, r"q_mm \*= -math\.sqrt", "q_mm *= math.sqrt",
      "tests/core/test_sh.py"),
    M("environments turned by half a texel", CORE, r"phi = \(np\.arange\(width\) \+ 0\.5\) \* \(2\.0 \* np\.pi / width\)",
      "phi = np.arange(width) * (2.0 * np.pi / width)", "tests/core/test_sh.py"),
    M("lighting turned the wrong way", CORE, r"return SHLighting\(rotation_matrix\(rotation, self\.order\) @",
      "return SHLighting(rotation_matrix(np.transpose(rotation), self.order) @", "tests/core/test_sh.py"),
    M("the lobe's energy not normalised", ANY, r"\(8\.0 \* np\.pi \* \(m \+ np\.exp2", "(4.0 * np.pi * (m + np.exp2",
      "tests/appearance/test_lobe.py"),
    M("a gain taken that may be sheen", STAGES, r"differ\(ratios, log_gain\)", "differ(ratios)", "tests/stages/test_gains.py"),
    M("gains to either side taken for one", STAGES, r"any\(np\.all\(\[side \* bound > SAME", "any(np.any([side * bound > SAME",
      "tests/stages/test_gains.py"),
    M("coarse meshes with a black outline", ANY, r"front = facing \| \(dr\.dot\(si\.n, si\.to_world\(si\.wi\)\) > 0\.0\)",
      "front = facing", "tests/render/test_blinnphong.py -k faces_away"),
    M("relighting keeps the old ambient term", OUTPUT, r"ambient = reflectance\.illumination\.ambient \* exposure \* after / before",
      "ambient = reflectance.illumination.ambient", "tests/output/test_views.py"),
    M("relief shown under another light", ANY, r"illumination=illumination, relief=None\)", "illumination=illumination)",
      "tests/output/test_relief_shown.py"),
    M("relief not shown under its own light", CORE, r"return self\.diffuse if self\.relief is None else",
      "return self.diffuse if True else", "tests/output/test_relief_shown.py"),
    M("relief written into exports", OUTPUT, r"diffuse, specular = reflectance\.diffuse if skin else",
      "diffuse, specular = reflectance.diffuse if False else", "tests/output/test_relief_shown.py"),
    M("residual shown under another light", ANY, r"reflectance=reflectance, residual=None, environment=None",
      "reflectance=reflectance, environment=None", "tests/output/test_residual_shown.py"),
    M("residual kept with an edited albedo", ANY, r"\*\*\{name: array\}\), residual=None\)", "**{name: array}))",
      "tests/output/test_residual_shown.py"),
    M("residual of one view kept whole", STAGES, r"found = \(weight\[\.\.\., None\] \* difference\)\.sum\(1\) / \(config\.prior",
      "found = (weight[..., None] * difference).sum(1) / (1e-6", "tests/stages/test_find_residual.py"),
    M("residual of a hand on the face", STAGES, r"is None else hidden\(label\) for label", "is None else hidden(label) & False for label",
      "tests/stages/test_find_residual.py"),
    M("light from one side left in the skin", STAGES, r"odd = np\.where\(known, 0\.5 \* \(level - opposite\), 0\.0\)",
      "odd = 0.0 * level", "tests/stages/test_relief.py"),
]  # fmt: skip

GEOMETRY = [
    M("w_r times 100", ANY, r"(prior_weight: float = number\()5e-5", r"\g<1>5e-3", "tests/test_paper.py"),
    M("w_l a tenth", ANY, r"(landmark_weight: float = number\()10\.0", r"\g<1>1.0", "tests/test_paper.py"),
    M("1 / |M_view| dropped", STAGES,
      r"return float\(rho\[observation\.ok\]\.sum\(\)\) / count, np\.where\(observation\.ok, weight, 0\.0\) / count",
      "return float(rho[observation.ok].sum()), np.where(observation.ok, weight, 0.0)", "tests/test_paper.py"),
    M("1 / |F_view| dropped", STAGES, r"weight=config\.landmark_weight / max\(len\(view\.index\), 1\)",
      "weight=config.landmark_weight", "tests/test_paper.py"),
    M("the photometric term in linear units, not 0..255", STAGES, r"^WHITE = 255\.0", "WHITE = 1.0",
      "tests/test_paper.py tests/stages/test_geometry_terms.py"),
    M("the prior's gradient dropped", STAGES, r"gradient\[inside\] \+= weight \* x\[at\]", "gradient[inside] += 0 * x[at]",
      "tests/stages/test_geometry_terms.py"),
    M("the elimination of point colours left out", STAGES, r"system\.dense\(\) - rows\.T @ rows", "system.dense()",
      "tests/stages/test_geometry_terms.py"),
    M("Geman and McClure's weight not squared", SOLVE, r"return squared \* q, q \* q", "return squared * q, q",
      "tests/solve/test_solve.py"),
    M("Huber's weight 1 everywhere", SOLVE, r"np\.where\(beyond, scale / np\.where\(beyond, r, 1\.0\), 1\.0\)",
      "np.ones_like(r)", "tests/solve/test_solve.py"),
    M("a step that raises the energy is taken", SOLVE, r"if ratio >= self\.minimum_ratio:.*", "if ratio >= -10.0:",
      "tests/solve/test_solve.py"),
    M("the damping grows with good steps", SOLVE, r"1\.0 - \(2\.0 \* ratio - 1\.0\) \*\* 3", "1.0 + (2.0 * ratio - 1.0) ** 3",
      "tests/solve/test_solve.py"),
    M("running out of iterations called converged", SOLVE, r"system, outcome = acceptance\.initial_size, None, Outcome\.MAX_ITERATIONS",
      "system, outcome = acceptance.initial_size, None, Outcome.CONVERGED", "tests/solve/test_solve.py"),
    M("the resume key without stage 2", "mifit/steps.py", r'"settings": \[\[type\(s\)\.__name__, dataclasses\.asdict\(s\)\] for s in step\.settings\],',
      '"settings": [] if step.part == "reflectance" else [dataclasses.asdict(s) for s in step.settings],',
      "tests/test_pipeline.py"),
    M("the resume key without what a step is given", "mifit/steps.py",
      r'"inputs": \{part: current\[part\] for part in step\.inputs\}', '"inputs": {}', "tests/test_pipeline.py"),
]  # fmt: skip

MESH = [
    M("the mesh stage's detail ten times longer", STAGES, r"length = config\.detail \* 10\.0 / model\.unit_mm",
      "length = config.detail * 100.0 / model.unit_mm", "tests/stages/test_refine_mesh.py"),
    M("trusted positions ignored", CORE, r"\+ self\._anchor\[:, None\] \* trusted", "+ 0.5 * self._anchor[:, None] * trusted",
      "tests/core/test_mesh_update.py"),
    M("folded faces stay folded", CORE, r"if not folded\.any\(\):", "if True:",
      "tests/core/test_mesh_update.py"),
    M("displacement with the wrong sign", CORE, r"return np\.sum\(at \* normals, axis=1\)",
      "return -np.sum(at * normals, axis=1)", "tests/core/test_mesh_update.py"),
    M("tangents of the wrong hand", ANY, r"np\.where\(orientation < 0, -1\.0, 1\.0\)", "np.where(orientation < 0, 1.0, -1.0)",
      "tests/output/test_export.py tests/output/test_folder.py"),
]  # fmt: skip

TERMS = [
    M("the paper's exponent 10", ANY, r"^    exponent = 5\.0", "    exponent = 10.0", "tests/test_paper.py"),
    M("Adam's exponent 10", STAGES, r"^PAPER_EXPONENT = 5\.0", "PAPER_EXPONENT = 10.0", "tests/test_paper.py"),
    M("the view difference's sign, Adam", STAGES, r"shown = _at\(s, self\.first\) - _at\(s, self\.second\)",
      "shown = _at(s, self.second) - _at(s, self.first)", "tests/test_paper.py"),
    M("the view difference's sign, objective", STAGES, r"shown = y\[:, 0\] \* \((\w+)\[:, a\] - (\w+)\[:, b\]\)",
      r"shown = y[:, 0] * (\1[:, b] - \2[:, a])", "tests/test_paper.py"),
    M("the view difference's sign, maps", STAGES, r"sr \+= \(both \* step \*", "sr -= (both * step *", "tests/test_paper.py"),
    M("the view difference's sign, lighting", STAGES,
      r"right \+= \(step \* both\[:, None\]\)\.T", "right -= (step * both[:, None]).T", "tests/test_paper.py"),
    M("lambda_S not applied by Adam", STAGES, r"pair = self\.difference \* dr\.sum", "pair = dr.sum", "tests/test_paper.py"),
    M("C_d smoothed instead of its offset, objective", STAGES,
      r"^    offset\[\.\.\., :3\] -= surface\.texels\.to_map.*$", "", "tests/test_paper.py"),
    M("C_d smoothed instead of its offset, maps", STAGES, r"^    base\[(?:\.\.\., )?3\] = 0\.0", "    base[...] = 0.0",
      "tests/test_paper.py"),
    M("both maps smoothed alike by Adam", STAGES, r"\((\w+), 1, 0, self\.smoothness\[1\]\)",
      r"(\1, 1, 0, self.smoothness[0])", "tests/test_paper.py"),
    M("w1 in other units", STAGES, r"config\.laplacian_weight \* NORMAL_STEPS / IMAGE_STEPS\*\*2",
      "config.laplacian_weight * NORMAL_STEPS / IMAGE_STEPS", "tests/test_paper.py"),
    M("w2 in other units", STAGES, r"config\.magnitude_weight \* \(NORMAL_STEPS / IMAGE_STEPS\) \*\* 2",
      "config.magnitude_weight * (NORMAL_STEPS / IMAGE_STEPS)", "tests/test_paper.py"),
    M("the paper's squares made robust", STAGES, r"if config\.robust else np\.inf", "if True else np.inf", "tests/test_paper.py"),
    M("the paper's ambient term pulled to zero", STAGES, r"if not config\.as_written:\n", "if True:\n", "tests/test_paper.py"),
    M("lambda_H for values of 0..1", "mifit/config.py", r"smoothness_weight=0\.001 / 255\.0", "smoothness_weight=0.001",
      "tests/test_paper.py"),
    M("preset with w2 ten times the paper's", "mifit/config.py", r"magnitude_weight=0\.3, robust=False",
      "magnitude_weight=3.0, robust=False", "tests/test_paper.py"),
    M("the light's strength not divided by its cosine", ANY, r"return power \* c / \(dr\.square\(c\) \+ guard \* guard\)",
      "return power * c", "tests/test_paper.py tests/appearance/test_models.py"),
]  # fmt: skip

SURFACE = [
    M("timesteps turn the other way", STAGES, r"np\.cross\(at\[k, some\], slope\)", "np.cross(slope, at[k, some])",
      "tests/stages/test_align_timesteps.py"),
    M("timesteps aligned without what expressions move", STAGES, r"^    bent = np\.einsum|^        bent = np\.einsum",
      "        bent = 0.0 * np.einsum", "tests/stages/test_align_timesteps.py"),
    M("what all timesteps do alike is theirs", STAGES, r"^            steps -= steps\.mean\(axis=0\)$", "            pass",
      "tests/stages/test_align_timesteps.py"),
    M("views of one timestep counted as of two", STAGES, r"if a\[0\] != b\[0\]$", "",
      "tests/stages/test_align_timesteps.py"),
    M("lids stay apart after they were measured", STAGES, r"^        found = close_again\(.*\)$", "        found = last.estimate",
      "tests/stages/test_close_openings.py"),
    M("outlines left out of the refit", STAGES, r"borders\.normal, borders\.precision, outside", "borders.normal, 0.0 * borders.precision, outside",
      "tests/stages/test_find_surface.py -k outlines_lead"),
]  # fmt: skip

EYES = [
    M("eyeballs matched at the lids", STAGES, r"self\.scenes = Scenes\(self\._faces,", "self.scenes = Scenes(model.faces,",
      "tests/stages/test_find_surface.py -k eyes"),
    M("tissue behind the lids taken for skin", STAGES, r"covering if lids is None else covering & lids", "covering",
      "tests/stages/test_eyes.py"),
    M("added eyes bend with the skin", STAGES, r"self\._by_skin = skin_weights\(model\)$", "self._by_skin = None",
      "tests/stages/test_find_surface.py -k eyes"),
    M("models keep the holes of their eyes", "mifit/config.py", r"(eyes: bool = flag\(\s+)True", r"\g<1>False",
      "tests/test_pipeline.py"),
    M("the paper's preset adds eyes", "mifit/config.py", r'camera_gains="never", eyes=False', 'camera_gains="never"',
      "tests/test_pipeline.py"),
    M("a model that got eyes taken for another one", "mifit/fitting.py", r"fitted_model\(model, config\)\.digest", "model.digest",
      "tests/test_fitting.py"),
    M("a truth without eyes given the faces of eyes", OUTPUT, r"model\.faces\[own\], model\.face_mask\[own\]",
      "model.faces, model.face_mask", "tests/output/test_render_evaluate.py"),
    M("a truth's maps read in the layout with eyes", "benchmarks/truth.py", r"return model\.uv if count == model\.n_vertices else .*",
      "return model.uv", "tests/test_table1.py"),
]  # fmt: skip

NEAR = [
    M("a near light as strong everywhere", ANY, r"reach / dr\.squared_norm\(position - points\)", "reach / reach",
      "tests/appearance/test_near_light.py"),
    M("shadows of what lies behind a near light", RENDER, r"ray\.maxt = reach", "pass", "tests/appearance/test_near_light.py"),
    M("candidates for a place as strong everywhere", ANY,
      r"dr\.gather\(mi\.Float, reach, light\) / dr\.squared_norm\(place - p\)", "mi.Float(1.0)",
      "tests/appearance/test_near_light.py"),
    M("intensity is what the centre receives", ANY, r"return self\.colour \* self\.distance\*\*2", "return self.colour",
      "tests/appearance/test_near_light.py"),
    M("places judged without what follows them", STAGES, r"^        gain \+= remaining\.right @ .*$", "",
      "tests/stages/test_near_light_search.py"),
    M("every compact light is near", STAGES, r"if best >= PLACES - 1:", "if False:",
      "tests/stages/test_near_light_search.py"),
    M("near lights carried around the world's origin", OUTPUT, r"lit\.rotated\(turn, middle\)", "lit.rotated(turn)",
      "tests/output/test_near_output.py"),
]  # fmt: skip

CAMERAS = [
    M("cameras move where matches don't tell", STAGES, r"ways\[:, squared > least\*\*2\]", "ways",
      "tests/stages/test_refine_cameras.py"),
    M("a refined rig stays where the first camera was", STAGES, r"poses = poses @ step", "poses = poses + 0.0 * step",
      "tests/stages/test_refine_cameras.py"),
    M("a camera's turn is taken for one about the origin", STAGES, r"moved\[3:, :3\] = cross_matrix\(shift\)", "pass",
      "tests/stages/test_refine_cameras.py"),
    M("refined cameras kept though nothing is better", STAGES, r"if judged\[1\] > BETTER \* judged\[0\] or", "if False and",
      "tests/stages/test_refine_cameras.py"),
    M("later steps don't see refined cameras", "mifit/steps.py", r'if "cameras" not in inputs or', "if True or",
      "tests/test_pipeline.py"),
    M("refined cameras forced on another calibration", CAPTURE, r"all\(self\.camera\(camera\.name\) == camera for",
      "all(True for", "tests/capture/test_capture.py"),
    M("results forget the calibration they refined", "mifit/result/*.py", r'capture\.get\("calibration", \[\]\)', "[]",
      "tests/test_pipeline.py"),
]  # fmt: skip

TIME = [
    M("a calibration that is off taken for time", STAGES, r"count \* product - movement \* shift", "count * product",
      "tests/stages/test_frame_offsets.py"),
    M("a camera that is later called earlier", STAGES, r"0\.5 \* \(after - before\)", "0.5 * (before - after)",
      "tests/stages/test_frame_offsets.py"),
    M("cameras out of step named again and again", ANY, r" if OUT_OF_STEP not in line\)", ")", "tests/stages/test_track.py -k step"),
    M("tracked frames aligned to themselves", STAGES, r"\[posed\], self\._looks\)", "[posed])", "tests/stages/test_align_timesteps.py"),
]  # fmt: skip

VIDEO = [
    M("a bias told in pixels alone", STAGES, r"SCATTER_OF_FACE \* float\(", "0.0 * float(", "tests/stages/test_find_surface.py -k bias"),
    M("a surface swept again is always kept", STAGES, r"kept = between\[1\] < between\[0\]", "kept = True",
      "tests/stages/test_sweep_again.py"),
    M("what judges is swept too", STAGES, r"swept = \[t for t in geometry\.timesteps if t not in judged\]",
      "swept = list(geometry.timesteps)", "tests/stages/test_sweep_again.py"),
    M("more timesteps are more certain", STAGES, r"found\.precision \* min\(1\.0, self\._count_as / len\(posed\)\)",
      "found.precision", "tests/stages/test_sweep_again.py"),
    M("frames that disagree are swept", ANY, r"if apart\(one\) < DISAGREES \* usual:", "if True:", "tests/test_resurfacing.py"),
    M("timesteps that aren't swept stay on the old surface", ANY, r"on_surface\(model, posed\.at\(\(timestep,\)\), found\.displacement\)",
      "on_surface(model, posed.at((timestep,)), geometry.displacement)", "tests/test_resurfacing.py"),
]  # fmt: skip

MUTATIONS = [*CONVENTIONS, *MEASURES, *LIGHT, *GEOMETRY, *MESH, *TERMS, *SURFACE, *EYES, *NEAR, *CAMERAS, *TIME, *VIDEO]
