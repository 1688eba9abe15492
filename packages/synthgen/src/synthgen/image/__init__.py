"""Image formation around a render: backgrounds, panoramas, composition, the camera's sensor."""
