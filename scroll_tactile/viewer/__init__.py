"""Memories, recordings and live sessions in Rerun's viewer: `rerun-importer-scroll-tactile`, and `live --rerun`."""
