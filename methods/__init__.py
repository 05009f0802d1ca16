"""What is measured: radiance-field methods and the kernels they stand on."""
