"""What a scene is made of: videos and folders of panoramas, one or several, as panoramas of one size."""
