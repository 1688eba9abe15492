"""What happens to pixels around a render: backgrounds, panoramas, composition, the camera's sensor."""
