"""NSVF, as a `bench.types.Method`."""

import math
from dataclasses import dataclass
from typing import Annotated

import torch

from bench.types import Budget, Scene
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.settings import Length, multiple
from methods.kernels.types import BRICK, LARGEST_SIDE, Occupancy, expect
from methods.nsvf.field import EMBEDDING, NsvfField
from methods.rendering.sampling import Sampling
from methods.students.fields import FieldLessons, FieldStudent, StudentTraining
from methods.students.voxels import occupied_voxels


@dataclass(kw_only=True, eq=False)
class Nsvf(FieldStudent):
    """A neural sparse voxel field with voxels where the field that it starts from is occupied."""

    training: FieldLessons
    resolution: Annotated[int, multiple(BRICK**2, LARGEST_SIDE)]  # voxels along a side of the cube
    step: Length  # length of a step of the rays in voxels, in training and rendering

    kind, model = "nsvf", ("resolution", "step")

    def __post_init__(self) -> None:
        super().__post_init__()
        channels, as_many = self.teacher.grid.channels, f"{EMBEDDING} channels (levels x features)"
        expect(channels == EMBEDDING, "teacher.grid", as_many, channels)

    def occupied(self, teacher: TrainedField) -> Occupancy:
        size = self.resolution
        known = teacher.occupancy
        return Occupancy.at(occupied_voxels(known, size), size, known.contracted)

    def sampling(self, budget: Budget) -> Sampling:
        return Sampling(step=self.step / self.resolution)

    def new_field(self) -> NsvfField:
        """Make a field of random embeddings, which `begin` replaces."""
        teacher = self.teacher
        how = teacher.precision, teacher.backend, teacher.generator()
        return NsvfField(self.occupancy, *how).to(teacher.device)

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> StudentTraining:
        """Make the training of a new field. Every corner begins as the teacher's encoding of its
        position, in 1 / pi of the usual size of embeddings: the angles of the positional encoding
        then begin at that size and reach 32 times it, which is still smooth from corner to corner.
        """
        training = super().begin(teacher, scene, budget)
        field = training.field
        assert isinstance(field, NsvfField)
        with torch.no_grad():
            features = teacher.field.encode(field.vertices / self.resolution)
            spread = features.std() if features.numel() > 1 else features.new_ones(())
            size = EMBEDDING**-0.5 / math.pi
            field.embeddings.copy_(features * size / spread.clamp(min=1e-12))
        return training
