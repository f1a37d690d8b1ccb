"""What a job needs: measured in a calibration, estimated stage by stage, and made to fit."""
