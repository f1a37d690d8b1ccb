"""What is made of models on request: pages in 3D, and files to save."""
