"""What a person looks at: a page of its own for every answer, and a picture beside it."""

from dsom_jax.view.page import render, write_page
from dsom_jax.view.picture import trajectory_figure
from dsom_jax.view.story import DriveHypotheses, DriveStory, Field, Lookalike, Plan, Remark, Story

__all__ = [
    "DriveHypotheses", "DriveStory", "Field", "Lookalike", "Plan", "Remark", "Story",
    "render", "trajectory_figure", "write_page",
]  # fmt: skip
