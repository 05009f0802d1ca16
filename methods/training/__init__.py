"""What every training needs: the loop, checkpoints, optimiser steps."""
