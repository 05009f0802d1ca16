"""3D Gaussian Splatting (Kerbl et al. 2023), with a fixed count (Kheradmand et al. 2024)."""
