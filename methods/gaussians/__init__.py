"""3D Gaussian Splatting (Kerbl et al. 2023), of a fixed number (Kheradmand et al. 2024)."""
