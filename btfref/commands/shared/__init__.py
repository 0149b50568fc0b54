"""What several commands share: reading arguments, printing, images, options, help of methods."""
