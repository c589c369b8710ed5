//! The camera: on the ego's roof, looking straight ahead.

use crate::geometry::Vec2;

/// Height above the ground.
pub(super) const EYE_HEIGHT_M: f64 = 1.7;
/// How far the camera is ahead of the ego's centre.
const EYE_AHEAD_M: f64 = 1.6;
const HALF_FIELD_OF_VIEW_DEG: f64 = 30.0;

/// A point as the camera sees it: metres to the right, above the camera, and ahead.
pub(super) type ViewPoint = [f32; 3];

#[derive(Debug, Clone, Copy)]
pub(super) struct Camera {
    pub(super) eye: Vec2,
    pub(super) forward: Vec2,
    pub(super) yaw: f64,
    /// In pixels of the picture.
    pub(super) focal: f64,
    /// Column and row of the optical axis, in pixels.
    pub(super) centre: f64,
}

impl Camera {
    pub(super) fn on_ego(position: Vec2, yaw: f64, image_size: usize) -> Self {
        let forward = Vec2::from_angle(yaw);
        let centre = image_size as f64 / 2.0;
        Self {
            eye: position + forward * EYE_AHEAD_M,
            forward,
            yaw,
            focal: centre / HALF_FIELD_OF_VIEW_DEG.to_radians().tan(),
            centre,
        }
    }

    pub(super) fn right(&self) -> Vec2 {
        -self.forward.left()
    }

    /// A direction on the ground, as seen: to the right and ahead.
    pub(super) fn direction(&self, direction: Vec2) -> ViewPoint {
        [
            direction.dot(self.right()) as f32,
            0.0,
            direction.dot(self.forward) as f32,
        ]
    }

    pub(super) fn view(&self, ground: Vec2, height: f64) -> ViewPoint {
        let [right, _, ahead] = self.direction(ground - self.eye);
        [right, (height - EYE_HEIGHT_M) as f32, ahead]
    }

    /// Column and row in pixels of a point ahead of the camera.
    pub(super) fn project(&self, [right, up, ahead]: ViewPoint) -> [f32; 2] {
        let scale = self.focal as f32 / ahead;
        let centre = self.centre as f32;
        [centre + right * scale, centre - up * scale]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera::on_ego(Vec2::new(3.0, -2.0), 0.7, 64)
    }

    #[test]
    fn thirty_degrees_is_the_edge_of_the_picture() {
        let camera = camera();
        for (angle, column) in [(30.0_f64, 64.0), (-30.0, 0.0), (0.0, 32.0)] {
            let direction = Vec2::from_angle(0.7 - angle.to_radians());
            let [x, _] = camera.project(camera.view(camera.eye + direction * 50.0, 1.0));
            assert!((x - column).abs() < 1e-3, "{angle} degrees at {x}");
        }
    }

    #[test]
    fn the_horizon_is_the_middle_row() {
        let camera = camera();
        let at = |distance, height| {
            camera.project(camera.view(camera.eye + camera.forward * distance, height))[1]
        };
        assert!((at(1e6, 0.0) - 32.0).abs() < 1e-3);
        assert!((at(10.0, EYE_HEIGHT_M) - 32.0).abs() < 1e-4);
        // 1.7 m below the eye at 1.7 / tan 30 degrees ahead is 30 degrees down: the lower edge.
        assert!((at(1.7 / 30.0_f64.to_radians().tan(), 0.0) - 64.0).abs() < 1e-3);
    }

    #[test]
    fn the_camera_is_ahead_of_the_centre() {
        let camera = Camera::on_ego(Vec2::default(), 0.0, 64);
        assert_eq!(camera.eye, Vec2::new(1.6, 0.0));
        assert_eq!(camera.view(Vec2::new(11.6, -2.0), 1.7), [2.0, 0.0, 10.0]);
    }
}
