// The film of the walk beside the signals: its time and the cursor are one.

import { token } from "./api.js";
import { SECOND } from "./time.js";

export class Film {
  constructor(about, app) {
    this.app = app;
    this.video = document.getElementById("video");
    this.field = document.getElementById("offset");
    this.there = Boolean(about);
    if (!about) return;
    document.getElementById("film").hidden = false;
    this.field.value = about.offset_s;
    this.field.addEventListener("change", () => this.seek(app.cursor));
    this.video.src = `/video?token=${encodeURIComponent(token)}`;
    const follow = () => {
      if (!this.video.paused) {
        app.setCursor(this.offset + this.video.currentTime * SECOND, { film: true });
        requestAnimationFrame(follow);
      }
    };
    this.video.addEventListener("play", follow);
    this.video.addEventListener("seeked", () => {
      if (this.asked === undefined) app.setCursor(this.offset + this.video.currentTime * SECOND, { film: true });
      this.asked = undefined;
    });
  }

  get offset() { return (Number(this.field.value) || 0) * SECOND; }

  // Show the picture of a time.
  seek(t) {
    if (!this.there || !this.video.paused) return;
    const at = (t - this.offset) / SECOND;
    const end = Number.isFinite(this.video.duration) ? this.video.duration : Infinity;
    const clamped = Math.min(Math.max(at, 0), end);
    if (Math.abs(clamped - this.video.currentTime) > 1e-4) {
      this.asked = clamped;
      this.video.currentTime = clamped;
    }
  }

  toggle() {
    if (!this.there) return;
    if (this.video.paused) this.video.play();
    else this.video.pause();
  }
}
