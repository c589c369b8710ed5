//! Writes a contact sheet of what the agent sees on the highway, with the segmentation below it.
//!
//! `cargo run --release -p isodream-envs --example look -- sheet.png [seed] [driver] [id ...]`

use std::error::Error;

use image::{Rgb, RgbImage, imageops};
use isodream_core::config::EnvConfig;
use isodream_envs::{ScriptedDriver, class, ids, make};

const COLUMNS: usize = 6;
const STEPS_BETWEEN: usize = 12;
const MAGNIFY: usize = 3;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments
        .next()
        .ok_or("usage: look SHEET.png [SEED] [DRIVER] [ID ...]")?;
    let seed = arguments.next().map_or(Ok(1), |text| text.parse())?;
    let driver: ScriptedDriver = arguments.next().as_deref().unwrap_or("reacting").parse()?;

    let mut chosen: Vec<String> = arguments.collect();
    if chosen.is_empty() {
        chosen = ids().iter().map(|id| (*id).to_owned()).collect();
    }

    let config = EnvConfig::default();
    let size = config.image_size;
    let tile = size * MAGNIFY;
    let rows = 2 * chosen.len();
    let mut sheet = RgbImage::new((COLUMNS * tile) as u32, (rows * tile) as u32);
    for (index, id) in chosen.iter().enumerate() {
        let mut env = make(&EnvConfig {
            id: id.clone(),
            ..config.clone()
        })?;
        let mut driver = driver.driver(seed);
        let mut transition = env.reset(seed)?;
        for column in 0..COLUMNS {
            let classes = env.segmentation().ok_or("no segmentation")?;
            let segmentation: Vec<u8> = classes.into_iter().flat_map(class_colour).collect();
            for (row, pixels) in [
                (2 * index, &transition.image),
                (2 * index + 1, &segmentation),
            ] {
                paste(&mut sheet, pixels, size, column * tile, row * tile);
            }
            for _ in 0..STEPS_BETWEEN {
                let action = driver.act(env.as_ref())?;
                transition = env.step(&action)?;
            }
        }
    }
    sheet.save(path)?;
    Ok(())
}

fn class_colour(seen: u8) -> [u8; 3] {
    match seen {
        class::ROAD => [110, 110, 120],
        class::VEHICLE => [235, 60, 50],
        _ => [40, 90, 50],
    }
}

fn paste(sheet: &mut RgbImage, pixels: &[u8], size: usize, x: usize, y: usize) {
    let tile = RgbImage::from_fn(size as u32, size as u32, |column, row| {
        let first = (row as usize * size + column as usize) * 3;
        Rgb([pixels[first], pixels[first + 1], pixels[first + 2]])
    });
    let side = (size * MAGNIFY) as u32;
    let tile = imageops::resize(&tile, side, side, imageops::FilterType::Nearest);
    imageops::replace(sheet, &tile, x as i64, y as i64);
}
