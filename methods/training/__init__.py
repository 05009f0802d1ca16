"""What every training needs: its loop, its checkpoints, steps of an optimiser."""
