r"""# The workspace

Every file of a workspace, format version 1. Text is UTF-8. CSV files have a header row and comma separators; an empty
cell means unknown. Numbers are written with full float64 precision. `.npz` files are uncompressed NumPy archives
without Python objects; their zip comment is `CRC-32 ` and the checksum (8 hex digits) of all that stands before it.

- Pixels are (x, y); (0, 0) is the centre of the top-left pixel of the stored raster, whatever its EXIF Orientation.
- Metres are in the world frame: the CRS of `block.json` minus its `origin_m`. x is east, y north, z up.
- Poses are `cam_from_world`: the camera has x right, y down, z forward.
- JSON files end with `checksum`: CRC-32 (hex) of the text before it. `files`: SHA-256 of files; of an SQLite database
  without journal mode and counters, which change when it is read.
- Files appear under their name complete or not at all. A fingerprint is a SHA-256 of all settings and inputs that a
  result depends on; a result is up to date where it is present with an equal fingerprint.

## The block

### config.yaml

The resolved configuration with which the results are made, every default included. `aeromatch run WORK/config.yaml`, as
`aeromatch run WORK`, repeats the run; where `asked.yaml` lies beside it, both follow that.

### asked.yaml

Only where `run --within` has reduced settings: the settings as they were asked for, written before `config.yaml` has
the reduced ones. `aeromatch run WORK` follows them and makes the rest.

### block.json

- `format_version`: 1.
- `crs`: code of the CRS, or `local`. `origin_m`: [x, y, z] that is subtracted from it. `given_crs`, `given_origin_m`:
  those of the given positions, which differ where the orientation could not use them.
- `metric`: whether lengths are metres; false in a frame of the pictures' own, whose scale is arbitrary: there every
  length of the workspace, whatever its name, counts in units of that frame.
- `ground_source`: where the ground height comes from, in words. `ground_z_m`: world height, null with a DEM or none.
- `frames`: image_id -> number of the frame of its own that its group lies in before the adjustment. `poses.csv` puts
  it aside of the others, where scale, north and place are arbitrary. Images that are not listed lie in the world.
- `gsd_m`: common ground sampling distance of the views of all images, metres per pixel; null without attitudes.
- `ground_fingerprint`: of the setting that the ground comes from.

### index.sqlite

What is known of the files, so that no command reads a file twice to learn the same thing. One table, `known`: `what`
(what was learnt, with a number that changes with the reader), `path` (below the workspace, or the whole path of a
picture), `status` (size, times of the last change of the contents and of the file in nanoseconds, inode: the row holds
as long as the file has it), `value` (JSON), `checksum` (CRC-32 of the other columns). Rows tell of features, matches
and verdicts their fingerprints, numbers, states and reasons, of pictures what their headers state, of other files their
SHA-256. The row `finished run` has instead of a status a digest of the settings, the program, and the status of every
input and every file: where it is the same, `aeromatch run` says at once that everything is up to date. Shards write
`index.<i>-of-<n>.sqlite`, which the run without `--shard` merges. All of it can be read from the files again: an index
may be deleted.

### images.csv

One line per image: `image_id` (unique slug of the relative path), `name` (relative path), `width_px`, `height_px`,
`camera_id`, `exif_orientation`, `time` (ISO 8601), `fingerprint` of the file; of its picture `blur` (0 sharp to 1: the
share of the differences of neighbouring pixels that is left after one more blur, Crete et al. 2007; sharp pictures have
0.15 to 0.35, one of a single value has 1, an entirely black one none), `black` and `white` (shares of the pixels at
either end of the scale), `damage` (what the decoder complains of), empty where it was not measured; `sha256` of the
file, by which one that was only touched is no other.

### cameras.csv

`camera_id`, `model` (COLMAP's name, or BROWN), `width_px`, `height_px`, `params`: separated by spaces, in the order of
cameras.md. cx and cy are in this workspace's pixel frame (COLMAP's minus 0.5).

### poses.csv

`image_id`; `x`, `y`, `z` of the projection centre, metres; `qw`, `qx`, `qy`, `qz` (`cam_from_world`, empty where the
attitude is unknown); `sigma_position_m`, `sigma_angle_deg`: standard deviations.

### pairs.csv

`image_id0`, `image_id1` (id0 < id1), `overlap` (share of the smaller footprint, 0-1), `view_angle_deg`, `reason` (the
rule that chose the pair).

## Orientation

What `orient` found. `cameras.csv` and `poses.csv` of the workspace are what all other stages use.

### orientation/orientation.json

- `images`: fingerprint of what was given of every image. `settings`: fingerprint of the rest.
- `result`: see [Result of orient](#result-of-orient).
- `failed`: images and rows of pairs that the first pass had to leave out; once they can be read again, `orient` starts
  anew.
- `tied`: pairs that the first pass verified. `similar`: pairs that look alike, where they were asked for.
- `groups`: images that were oriented together, the largest group first: `kind` (`given`, `positions`, or `level`: no
  positions, scale and origin arbitrary), `images`. `terrains`: names of the files of terrain.

### orientation/cameras.csv, poses.csv

As those of the workspace.

### orientation/terrain.tif

Heights of the terrain in the block's CRS, GeoTIFF, float32. Missing where the pictures tell none. Flights that lie
apart have one each: `terrain-2.tif` and so on.

### orientation/orientation.csv

Written by `adjust`: the bundle adjustment of the verified matches. One line per image of known place, in the block's
CRS: `image` (its name); `x`, `y`, `z` of the projection centre, metres; `omega_deg`, `phi_deg`, `kappa_deg`
(photogrammetric, against the grid of the CRS); `sigma_x_m` to `sigma_kappa_deg`: standard deviations, empty where
they are not known; `camera`: camera_id; `frame`: `world`, or `own N` of a group that no position has placed (place,
north and scale are arbitrary; standard deviations hold within the group, those of positions are empty), or
`predicted` of an image that is not oriented: the position given, the attitude given or that of its strip, empty where
nothing is known; `unit`: of all lengths of the line, `m`, or `arbitrary` in a frame of its own.

### orientation/residuals.csv

Written by `adjust`: the adjusted block beside what was given, and how well its images fit their points. One line per
adjusted image: `image` (its name); `dx_m`, `dy_m`, `dz_m`: adjusted less given position; `rotation_x_deg`,
`rotation_y_deg`, `rotation_z_deg`: rotation vector about the axes of the world that turns the given attitude into the
adjusted one; `dx_sigmas` to `dz_sigmas` and `rotation_x_sigmas` to `rotation_z_sigmas`: the same in the standard
deviations that were stated, each axis in its own. All are empty where nothing was given, and in a frame of its own.
`error_px`: mean reprojection error; `points`: of the image; `images_per_point`: how many images see them, mean.

### orientation/adjusted.npz

N images, P points, O observations, C cameras.

- `images` (N,) str: image_id. `frames` (N,) int32: number of its group's own frame, 0 in the world. `rotations`
  (N, 3, 3), `centers_m` (N, 3), `sigmas_m` (N, 3), `sigmas_deg` (N, 3: omega, phi, kappa), `sweeps_m` (N, 3: by how
  much the centre moves while a rolling shutter reads the picture, first row to last): float64.
- `points_m` (P, 3), `errors_px` (P,) float64: triangulated points and their mean reprojection errors.
- `track_images`, `track_keypoints`, `track_points` (O,) int32: row of `images`, keypoint of that image, row of
  `points_m`.
- `cameras` (2, C) str: camera_id, and model, width and height; `params` (C,) str: as in `cameras.csv`.

### orientation/final.npz

As `adjusted.npz`, with the points and observations that are left once the matches of `dropped.npz` are gone; absent
where that is all. `export` and `report` show these.

### refined/<id>.npz

Where keypoints were measured anew by least-squares matching (`refine`); absent with `refine=none`. What is adjusted,
judged, exported, drawn and evaluated has these places; features, matches and two-view models keep those of the
detector, by which the errors that colours show were found.

- `keypoints_px` (K, 2) float32: of all keypoints of features/<id>.npz; `measured` (K,) bool: those that stand for their
  points, or were brought onto one that does. `fingerprint`: that of the features.

### refined/measured/<id>.npz

Measurements of one image's keypoints by those of others, kept so that only what has changed is measured again. They may
be deleted.

- `shifts_px` (N, 2) float32, stored pixels; `held` (N,) bool: whether they hold; `matrices` (N, 2, 2) float32: pixels
  of the image from those of the other one. `fingerprint`: of all that they depend on.

### orientation/dropped.npz

Verified matches that contradict the adjusted block or are not likely to be right, of D pairs. Whoever reads results
goes without them: `export`, `report` and `evaluate` do.

- `images` (D, 2) str: image ids; `fingerprints` (D,) str: of the pair's entry in `verified/`, for which alone this
  holds.
- `counts` (D,) int64: matches dropped, `rows` (sum of counts,) int32: which rows of the pair's matches.
- `least`: a pair that keeps fewer matches is rejected.

### orientation/first_pass/

Features and matches of reduced images; laid out like this workspace. It may be deleted.

## Pictures

### enhanced/<id>.png, <id>.mask.png, <id>.json

The enhanced picture (kept by the single stage and with `--keep-images`); the mask (255 = treated); a record with
`fingerprint`, `picture` (whether the picture is kept), the strategy's own facts and `files`. Images that are not
enhanced have none.

### simulated/<id>/views.json, pictures.json, <view>.png

- `fingerprint`, `files`. `scale`: stored raster to the raster that the views
  were made of. `remark`: why another ground than the terrain below the image is looked at, else empty.
- `views`: list of `name`, `width_px`, `height_px`, `is_source`, `angle_deg`, `enhanced`, `undistorted_from_view` (3x3).
  Source pixel = distort(camera, `undistorted_from_view` . view pixel). With `is_source` the view is the raster itself.
  With `scale` < 1 the camera is the one resized by it. View `far` is a part of the undistorted image, a few pixels
  larger or smaller than what it shows: only ground that the box of the ground view leaves out, the rest is black.
- `<view>.png`: gray picture of the view. `simulate`, and every command with `--keep-images`, writes them, in place of
  earlier ones; other commands leave them as they are.
- `pictures.json`: as views.json, of the views that the PNGs show; it differs from views.json where features were found
  with other settings since. Absent without PNGs.

## Features and matches

### features/<id>.npz

K keypoints, D descriptors, V views. A keypoint may have several descriptors.

- `fingerprint` () str
- `keypoints_px` (K, 2) float32: stored raster, merged over views. `sizes_px` (K,) float32: diameter. `responses` (K,)
  float32.
- `descriptors` (D, C) uint8 (RootSIFT x 512, or the network's) or float32. `descriptor_keypoint_idx` (D,) int32.
- `view_idx` (D,) int32. `view_keypoints_px` (D, 2) float32, `view_size_px` (D,) float32 and `view_orientation_deg` (D,)
  float32: place, diameter and direction in the view's own frame.
- `view_sizes_px` (V, 2) int32: width, height. `view_angles_deg` (V,) float32: angle to the optical axis.
- `view_directions` (V, 3) float32: unit vectors in the world frame; `view_gsd_m` (V,) float32; NaN where unknown.
- `view_enhanced` (V,) bool: whether the view shows the enhanced picture.
- `colours` (K, 3) uint8: RGB around each keypoint; only with `extract.colours`.

With a `cascade` these are the keypoints of all steps that looked at the image, without descriptors and views:
`keypoints_px`, `sizes_px`, `responses`; `kinds` (S,) str: names of the steps; `kind_idx` (K,) uint8: the first of them
that found a keypoint; `numbers_<step>` (K_step,) int32: number here of each keypoint of the step's own file.

### steps.csv, and the files of each step

Only with a `cascade`. `image_id0`, `image_id1`, `steps` (those that the pair took, joined by +), `reasons` (why it took
the further ones), `settled_by` (the step after which it needed nothing more, empty where it lacks matches in the end),
`lacks` (what it lacks in the end; an overlap in these words is the share of an image that shows ground of the other,
not that of the footprint as in pairs.csv), `verified` (verified matches of all steps, those that two of them have found
counted once, before the pair is verified as a whole), `expected` (how many were expected after the last step that it
took; empty where overlap or view angle are unknown, or nothing is known of the step). What a step makes lies
in a folder of its name, written like the files of the block that join it: `features/<step>/`, `matches/<step>/`,
`verified/<step>/`, `simulated/<step>/`, `enhanced/<step>/`, `reports/<step>/`. `guided` has no features: it uses those
of the step `first`.

### matches/<id0>.npz

One row: all P pairs of id0, concatenated. Pair p owns the entries `offsets[p]` to `offsets[p + 1]` of M matches.

- `image_id1` (P,) str. `fingerprint` (P,) str. `offsets` (P + 1,) int64. `strategy` (P,) str: the matcher.
- `features0`, `features1` (P,) str: fingerprints of the feature files that `indices` point into.
- `indices` (M, 2) int32 into both keypoint lists; -1 for a point that was measured without a keypoint.
- `scores` (M,) float32 in 0-1, larger is better. `view_pairs` (M, 2) int16: the views that were compared.
- `points0_px`, `points1_px` (M, 2) float64: measured places; only where some index is -1.
- `sigmas_px` (M,) float32: standard deviation of a measured place; only where a matcher states it.
- `remark` (P,) str: why a matcher that registers pairs as a whole found nothing; only where one did.

### verified/<id0>.npz

The same row layout with the kept matches: `image_id1`, `fingerprint`, `features0`, `features1`, `offsets`, `indices`,
`scores` and, where there are any, `points0_px`, `points1_px`, `sigmas_px`, as above.

- `errors_px` (M,) float32: error to the model, undistorted pixels; NaN where unknown.
- `state` (P,) str: `verified`, `rejected` or `not verifiable`. `reason` (P,) str.
- `model_kind` (P,) str: E, F, H or empty. `models` (P, 3, 3) float64: E on normalised rays, F and H on undistorted
  pixels.
- `rotations` (P, 3, 3) float64: cam1_from_cam0 of the model, NaN where it has none.
- `matches_in` (P,) int64: matches before filtering. `rejected` (P,) str: JSON object, filter -> matches it dropped.

## Reports and results

### reports/<stage>.json, <stage>.i-of-n.json

- `stage`, `seconds`, `items`, `done`, `skipped` (already up to date), `failed`, `fingerprint`.
- `failures`: [[item, reason], ...].
- `files`: of a stage of the whole block, SHA-256 of the files that it has written, by their names in the workspace. The
  stage is up to date where its `fingerprint` is that of the present settings and inputs and these files are as they
  were written.
- `result`: what the stage has found, null for nothing; see [Results of stages](#results-of-stages). Images are named
  by their ids, in what `--json` prints by their names.

### failures.csv

`stage`, `item`, `reason`: every image or pair that failed, by the names of the files, a pair as `NAME0 and NAME1`.

### lost.csv

Written by `run` and `adjust`: every image of the folder that the result does not hold. `image` (relative path), `what`
(`left out` of the block, such as a picture with a damaged header or one that no camera is known of; `not read`, where
its pixels could not be; `not oriented`; of a block that was not adjusted `not connected`), `reason`. Without lines
where every image is held.

### .lock

Held by the command that works on the workspace (shards hold it together), and empty where none does. The system lets go
of it when a process ends, however it ends.

### report/index.html

The page that a person looks at; it needs no network.

### report/pictures/, report/pairs/

Of blocks of more than 300 images: reduced pictures (JPEG, as viewers show them) and the matches of pairs, which the
page loads when a pair is drawn. Up to 300 images all of it is in the page.

### evaluation/

Written by `aeromatch evaluate`: `evaluation.json` (`format_version`, `workspace`, `truth`, `truth_kind`, `images`,
`left_out`, `min_overlap`, `totals`, `conditions`, `summary`, `consumer`, `seconds`; null where unknown), `pairs.csv`
(one
line per pair), `conditions.csv`, plots as PNG.

### export/colmap/

`database.db` and `sparse/{cameras,images,points3D}.txt` in COLMAP's own formats and pixel frame (this workspace's plus
0.5). `sparse/` holds the adjusted block: cameras, oriented images with their keypoints, and triangulated points with
their tracks; without adjustment the poses of the orientation, or those given, alone. The pose priors of the database
are the given positions. Cameras of the database are those that COLMAP's mappers can refine: the nearest OPENCV where
the lens has k3 or skew. `orientation.csv`: as above; `residuals.csv` too, with the points that final matches hold.
`world.json`: `crs`, `origin_m`; a coordinate in the CRS is the one here plus the origin; `unit`: `m`, or `arbitrary`
in a frame of the pictures' own.

Groups of images whose place beside each other is not known are models of their own. `sparse/` holds what positions have
placed in the world, else the largest group; `sparse_own2/` is the model of the images with the frame `own 2` in
`orientation.csv`, with a `world.json` of its own, since it lies in no CRS. Numbers of images and cameras are those of
the database in all models; points are numbered model by model. `frames` of the upper `world.json` lists them: `model`
(folder), `frame` (as in `orientation.csv`), `unit`, `images` (names). It is absent where all lie in the block's frame.
"""


def page() -> str:
    """docs/workspace.md: this specification as Markdown, and the results of stages by their types."""
    from aeromatch_cli import graph
    from aeromatch_cli.results.page import text

    heading, _, rest = (__doc__ or "").partition("\n\n")
    made = (
        "This page is made from the specification in the code: `python -m aeromatch_cli.formats > docs/workspace.md`."
    )
    words = "This is what stages find: it stands in their reports and in the last line that `--json` prints."
    results = text(stage.result for stage in graph.STAGES)
    return f"{heading}\n\n{made}\n\n{rest}\n## Results of stages\n\n{words}\n\n{results}"
