"""The commands ``probmotion lift`` and ``probmotion reconstruct``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

if TYPE_CHECKING:
    from probmotion.io.keypoints.tracks import KeypointFile
    from probmotion.motion.motion import KeypointTrack

__all__ = ["Lift", "Reconstruct"]

_RATE_ERROR = 0.01  # of frame rates that are rounded, or from rounded timestamps


@dataclass(frozen=True, kw_only=True)
class Lift:
    """Lift a video's 2D keypoints to 3D motion with its uncertainty.

    Writes to --out: lift.html (the motion in a browser), lift.bvh and lift.glb (for Blender),
    lift.npz (mean, standard deviations and draws), lift.smpl22.npz (positions and rotations of
    SMPL's body joints) and summary.json. With several people each has a folder of its own.
    """

    keypoints: Positional[tuple[Path, ...]]
    """Keypoints of a still camera: file or folder of a detector (see probmotion show). With
    --camera also one of every camera, or a folder of Pose2Sim with a folder of every camera."""

    out: Path
    """Output folder."""

    image_size: Annotated[
        tuple[int, int] | None, arg(metavar="WIDTH HEIGHT", help_behavior_hint="")
    ] = None
    """Size of the video, pixels; the file's by default. Required if it has none, without --camera.
    """

    camera: Annotated[Path | None, arg(metavar="TOML", help_behavior_hint="")] = None
    """Calibration of Pose2Sim: the motion is in its world. Files and folders are named after its
    cameras or in their order."""

    fps: float | None = None
    """Frame rate, frames per second; the file's by default."""

    skeleton: str | None = None
    """Layout of the keypoints; recognised by default."""

    people: int | None = None
    """Number of people to track, in files without track ids."""

    person: int | None = None
    """Index of the person to lift; all by default."""

    fov: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="")] = None
    """Horizontal field of view, degrees: distances from the camera depend on it. By default about
    60 along the longer side (39 to 87 in 90 % of videos), and each draw has its own."""

    pitch: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="")] = None
    """Angle of the camera above the horizon, degrees, negative if it looks down. Estimated by
    default, badly for motion unlike that of the prior."""

    height: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """Height of the person, metres; 1.7 ± .1 by default."""

    flip: Annotated[
        Literal["x", "y", "xy"] | None, arg(metavar="{x,y,xy}", help_behavior_hint="")
    ] = None
    """Mirror coordinates of the keypoints: y if y points up, xy if the video is upside down, x if
    the image was mirrored after detection."""

    draws: int = 100
    """Number of posterior draws."""

    seed: int = 0
    """Seed of the draws."""

    strict: FlagCreatePairsOff[bool] = False
    """Fail (exit status 2) if a motion does not pass all checks."""

    def run(self) -> None:
        from probmotion.files import check_writable
        from probmotion.lifting.recording_lift import lift

        paths = self._paths()
        if len(paths) > 1 and self.person is not None:
            raise ValueError(
                "--person must not be given with several cameras, whose people may have other "
                f"numbers, got {self.person}; associate people before (pose-associated of Pose2Sim)"
            )
        files = [self._file(path) for path in paths]
        size = self.image_size
        if self.camera is None:
            size = size or files[0].image_size
            if size is None:
                raise ValueError(
                    "--image-size or --camera must be given, got neither; --image-size 1920 1080 "
                    "is a video of this width and height"
                )
        if self.flip is not None:
            files = self._flipped(self.flip, files, size)
        people = self._people(paths, files)
        check_writable(self.out)
        doubtful, refused = [], []
        for number, tracks in enumerate(people):
            folder = self.out if len(people) == 1 else self.out / f"person-{number}"
            try:
                result = lift(
                    tracks,
                    image_size=size,
                    camera=self.camera,
                    fov=self.fov,
                    pitch=self.pitch,
                    height=self.height,
                    draws=self.draws,
                    seed=self.seed,
                )
            except ValueError as error:
                if len(people) == 1:
                    raise
                refused.append(error)
                print(f"person {number} was not lifted: {error}")
                continue
            result.save(folder)
            print("\n".join(result.summary()))
            if first := min(track.start or 0 for track in tracks):
                print(f"Frame 0 of the motion is frame {first} of the video.")
            print(
                f"wrote {folder / 'lift.html'}, lift.bvh, lift.glb, lift.npz, lift.smpl22.npz, "
                "summary.json"
            )
            if not result.trusted:
                doubtful.append(str(folder))
        if len(refused) == len(people):
            raise refused[0]
        if self.strict and refused:
            raise refused[0]
        if self.strict and doubtful:
            raise ValueError(
                f"motions must pass all checks with --strict, got failures in "
                f"{', '.join(doubtful)}; see lift.html"
            )

    def _paths(self) -> list[Path]:
        """Return the file or folder of every camera."""
        from probmotion.io.keypoints.calibration import view_folders

        paths = list(self.keypoints)
        if not paths:
            raise ValueError("KEYPOINTS must be a file or folder of a detector, got none")
        if self.camera is not None and len(paths) == 1:
            return view_folders(paths[0])
        if self.camera is None and len(paths) > 1:
            raise ValueError(f"--camera must be given for several files, got {len(paths)} files")
        return paths

    def _file(self, path: Path) -> KeypointFile:
        """Return the content of a file."""
        from probmotion.io.keypoints.files import open_keypoints

        file = open_keypoints(path, self.fps, self.skeleton, self.people, self.image_size)
        if file.fps is None:
            raise ValueError(
                f"--fps must be given for {path}, which contains no frame rate, got none; --fps 30 "
                "is a video of 30 frames per second"
            )
        if file.declared_fps and abs(file.fps / file.declared_fps - 1) > _RATE_ERROR:
            raise ValueError(
                f"--fps must be the frame rate of {path}, {file.declared_fps:g}, got {self.fps:g}; "
                "leave it out"
            )
        if self.camera is None:
            return file
        return replace(file, tracks=[replace(track, name=path.stem) for track in file.tracks])

    def _flipped(
        self, axes: str, files: list[KeypointFile], size: tuple[int, int] | None
    ) -> list[KeypointFile]:
        """Return files with mirrored coordinates, of the image's size or those of the cameras."""
        from probmotion.io.keypoints.calibration import read_calibration

        if self.camera is None:
            assert size is not None
            sizes = [size]
        else:
            calibration = read_calibration(self.camera)
            found = calibration.matched([file.tracks[0].name for file in files])
            sizes = [calibration.sizes[index] for index in found]
        return [
            replace(file, tracks=[track.flipped(axes, each) for track in file.tracks])
            for file, each in zip(files, sizes, strict=True)
        ]

    def _people(self, paths: list[Path], files: list[KeypointFile]) -> list[list[KeypointTrack]]:
        """Return the tracks of every person, one a camera."""
        if len(files) == 1:
            tracks = files[0].tracks
            if self.person is None:
                return [[track] for track in tracks]
            if not 0 <= self.person < len(tracks):
                people = "a single person, 0" if len(tracks) == 1 else f"0 to {len(tracks) - 1}"
                raise ValueError(f"--person must be {people}, got {self.person}")
            return [[tracks[self.person]]]
        for path, file in zip(paths, files, strict=True):
            if len(file.tracks) != 1:
                raise ValueError(
                    f"keypoints of several cameras must be of one person, got {len(file.tracks)} "
                    f"in {path}; associate people before (pose-associated of Pose2Sim)"
                )
        return [[file.tracks[0] for file in files]]


@dataclass(frozen=True, kw_only=True)
class Reconstruct:
    """Reconstruct an animal or person from one image or the images of a clip, in 3D and motion.

    Writes to --out: reconstruct.html (the images, other views and posterior draws in motion),
    body.glb (textured surface with a skeleton and four motions, for Blender), reconstruction.npz
    (the first motion and all draws) and summary.json.
    """

    image: Positional[tuple[Path, ...]]
    """Image, or all images of a clip, in the order of time and of one size."""

    mask: tuple[Path, ...] = ()
    """Mask of the body, one for each image; the image's opacity by default."""

    features: tuple[Path, ...] = ()
    """Image features (.npz, one array of rows, columns and channels), one file for each image, for
    a category that was trained with such features."""

    category: str
    """Kind of body: quadruped, person, or the file of a trained category."""

    out: Path
    """Output folder."""

    fov: Annotated[float, arg(metavar="DEGREES", help_behavior_hint="")] = 40.0
    """Field of view along the longer side of the image, degrees; 40 by default."""

    draws: int = 100
    """Number of posterior draws."""

    seed: int = 0
    """Seed of the draws."""

    def run(self) -> None:
        from probmotion.files import check_writable
        from probmotion.models.images.category import Category
        from probmotion.models.images.observation import ImageObservation
        from probmotion.reconstruction.inference import reconstruct
        from probmotion.validation import check_count

        check_count("draws", self.draws, 2)
        check_count("seed", self.seed, 0)
        category = Category.load(self.category)
        observation = ImageObservation.read(
            _one_or_all(self.image),
            _one_or_all(self.mask) if self.mask else None,
            features=_one_or_all(self.features) if self.features else None,
            fov=self.fov,
        )
        category.check_features(observation.features)
        category.check_images(observation.images)
        check_writable(self.out)
        result = reconstruct(observation, category, draws=self.draws, seed=self.seed)
        result.save(self.out)
        print("\n".join(result.summary()))
        print(f"wrote {self.out / 'reconstruct.html'}, body.glb, reconstruction.npz, summary.json")


def _one_or_all(paths: tuple[Path, ...]) -> Path | list[Path]:
    return paths[0] if len(paths) == 1 else list(paths)
